"""A dataset's masks and depths reach the views that mining looks at."""

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_openspm.errors import ObservationError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.vector_layout import parse_layout
from lerobot_openspm.mining.dataset import Demonstrations

SIZE = 64
KEY = "observation.images.front"
NAMES = ["x", "y", "z", "gripper"]
LABELS = np.arange(2 * SIZE * SIZE).reshape(2, 1, SIZE, SIZE) % 5
DEPTH = np.linspace(0.2, 2.0, 2 * SIZE * SIZE).reshape(2, 1, SIZE, SIZE)


def dataset(root, mask_size=SIZE):
    """Two frames with a mask and a depth each."""
    features = {
        KEY: {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]},
        "observation.masks.front": {"dtype": "int32", "shape": (1, mask_size, SIZE), "names": None},
        "observation.depth.front": {"dtype": "float32", "shape": (1, SIZE, SIZE), "names": None},
        "observation.state": {"dtype": "float32", "shape": (4,), "names": NAMES},
        "action": {"dtype": "float32", "shape": (4,), "names": NAMES},
    }
    made = LeRobotDataset.create("local/layers", 20, features, root=root, use_videos=False)
    for labels, depth in zip(LABELS, DEPTH, strict=True):
        made.add_frame(
            {
                KEY: np.full((SIZE, SIZE, 3), 7, np.uint8),
                "observation.masks.front": labels[:, :mask_size].astype(np.int32),
                "observation.depth.front": depth.astype(np.float32),
                "observation.state": np.zeros(4, np.float32),
                "action": np.zeros(4, np.float32),
                "task": "push the plate",
            }
        )
    made.save_episode()
    made.finalize()
    return LeRobotDataset("local/layers", root=root)


def views(root, frame, **options):
    layout = [parse_layout(NAMES, kind) for kind in ("state", "action")]
    demonstrations = Demonstrations(dataset(root, **options), *layout)
    camera = Camera(SIZE, SIZE, 50.0, 50.0, 31.5, 31.5, "world", np.eye(4))
    return demonstrations.views(demonstrations.episodes()[0], frame, {KEY: camera})


def test_masks_and_depths_are_read_frame_by_frame(tmp_path):
    view = views(tmp_path / "data", 1)[KEY]
    np.testing.assert_array_equal(view.labels, LABELS[1, 0])
    np.testing.assert_allclose(view.depth, DEPTH[1, 0], rtol=1e-6)
    assert (view.image == 7).all()


def test_masks_of_another_size_are_refused(tmp_path):
    with pytest.raises(
        ObservationError, match=r"masks\.front' has shape \(1, 60, 64\), expected \(1, 64, 64"
    ):
        views(tmp_path / "data", 0, mask_size=60)
