"""Features followed through drawn images."""

import cv2
import numpy as np
import pytest

from lerobot_openspm.calibration.tracks import MIN_FRAMES, track_features


def moving_square(height: int, frames: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """A light square that moves over a dark ground beside one that stands; corners ``(frames, 4, 2)``."""
    unit, images, corners = height / 128, [], []
    for t in range(frames):
        image = np.full((8 * 128, 8 * 128, 3), 40, np.uint8)
        cv2.rectangle(image, (8 * 90, 8 * 90), (8 * 110, 8 * 110), (200, 200, 200), -1)
        low = np.array([20 + 2 * t, 30 + t])
        cv2.rectangle(image, tuple((8 * low).tolist()), tuple((8 * (low + 24)).tolist()), (220, 220, 220), -1)
        images.append(cv2.resize(image, (height, height), interpolation=cv2.INTER_AREA))
        square = low + 24 * np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
        corners.append(square * unit - 0.5)
    return np.array(images), np.array(corners)


@pytest.mark.parametrize("height", [128, 256, 640])
def test_corners_are_followed_to_a_fraction_of_a_pixel(height: int):
    images, corners = moving_square(height)
    tracks = track_features(images, 3, moving_only=True)
    met = set()
    for track in tracks:
        assert track.episode == 3
        true = corners[track.start : track.start + len(track.uv)]
        errors = np.linalg.norm(track.uv[:, None] - true, axis=2)
        nearest = int(errors[0].argmin())
        if errors[0, nearest] < 0.02 * height:
            assert errors[:, nearest].max() < 0.6 * height / 128
            met.add(nearest)
    assert met == {0, 1, 2, 3}


def test_a_still_camera_begins_tracks_only_where_something_moves():
    images, _ = moving_square(256)
    near_still = lambda t: (np.abs(t.uv[0] - 200) < 30).all()  # noqa: E731
    assert not any(near_still(t) for t in track_features(images, 0, moving_only=True))
    assert any(near_still(t) for t in track_features(images, 0, moving_only=False))


@pytest.mark.parametrize("images", [np.zeros((20, 64, 64, 3)), np.full((1, 64, 64, 3), 90)])
def test_empty_images_and_one_frame_have_no_tracks(images: np.ndarray):
    assert track_features(images.astype(np.uint8), 0, moving_only=False) == []


def test_what_is_seen_too_shortly_is_dropped():
    images, _ = moving_square(256, frames=MIN_FRAMES - 1)
    assert track_features(images, 0, moving_only=False) == []
