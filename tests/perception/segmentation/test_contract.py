"""What every segmentation backend owes its caller, whichever it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.perception.segmentation.backends import BACKENDS, PHRASES, Backend

from lerobot_openspm.errors import ObservationError, PerceptionError


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small models on many threads are slower, and several workers share the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> Backend:
    return BACKENDS[request.param]()


def assert_same(a, b):
    assert a.keys() == b.keys()
    for phrase in a:
        assert a[phrase].keys() == b[phrase].keys()
        for camera, instances in a[phrase].items():
            assert len(instances) == len(b[phrase][camera])
            for one, other in zip(instances, b[phrase][camera], strict=True):
                np.testing.assert_array_equal(one.mask, other.mask)
                assert one.confidence == other.confidence


def test_every_phrase_and_camera_has_its_instances_in_order(backend: Backend):
    found = backend.segmenter.segment(backend.views, PHRASES)
    assert tuple(found) == PHRASES
    assert any(instances for by_camera in found.values() for instances in by_camera.values())
    for by_camera in found.values():
        assert by_camera.keys() == backend.views.keys()
        for camera, instances in by_camera.items():
            assert isinstance(instances, tuple)
            for one in instances:
                assert one.mask.dtype == np.bool_
                assert one.mask.shape == backend.views[camera].image.shape[:2]
                assert one.mask.any()
                assert isinstance(one.confidence, float)
                assert 0 <= one.confidence <= 1
            confidences = [one.confidence for one in instances]
            assert confidences == sorted(confidences, reverse=True)


def test_what_is_not_there_has_empty_entries(backend: Backend):
    found = backend.blind.segment(backend.empty, PHRASES)
    assert found == {phrase: dict.fromkeys(backend.empty, ()) for phrase in PHRASES}


def test_the_same_question_has_the_same_answer(backend: Backend):
    first, second = (backend.segmenter.segment(backend.views, PHRASES) for _ in range(2))
    assert_same(first, second)


def test_phrases_do_not_disturb_one_another(backend: Backend):
    together = backend.segmenter.segment(backend.views, (*PHRASES, PHRASES[0]))
    one_by_one = {phrase: backend.segmenter.segment(backend.views, [phrase])[phrase] for phrase in PHRASES}
    assert_same(together, one_by_one)


def test_a_black_image_is_an_image(backend: Backend):
    black = {camera: replace(view, image=view.image * 0) for camera, view in backend.views.items()}
    found = backend.segmenter.segment(black, PHRASES)
    assert {phrase: by_camera.keys() for phrase, by_camera in found.items()} == {
        phrase: black.keys() for phrase in PHRASES
    }


def test_the_views_are_left_as_they_are(backend: Backend):
    before = {camera: (view.image.copy(), view.labels.copy()) for camera, view in backend.views.items()}
    backend.segmenter.segment(backend.views, PHRASES)
    for camera, (image, labels) in before.items():
        np.testing.assert_array_equal(backend.views[camera].image, image)
        np.testing.assert_array_equal(backend.views[camera].labels, labels)


def test_nothing_asked_is_nothing_found(backend: Backend):
    assert backend.segmenter.segment(backend.views, []) == {}
    assert backend.segmenter.segment({}, PHRASES) == {phrase: {} for phrase in PHRASES}


@pytest.mark.parametrize("phrases", [[" "], "block"])
def test_a_question_that_is_none_is_refused(backend: Backend, phrases):
    with pytest.raises(PerceptionError, match=r"name every object|pass \['block'\]"):
        backend.segmenter.segment(backend.views, phrases)


def test_a_malformed_view_is_refused(backend: Backend):
    views = {camera: replace(view, image=view.image[:50]) for camera, view in backend.views.items()}
    with pytest.raises(ObservationError, match=r"image of shape \(50, 160, 3\).*expected \(160, 160, 3\)"):
        backend.segmenter.segment(views, PHRASES)
