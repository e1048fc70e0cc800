"""Grounding DINO with SAM 2.1: boxes by phrase, masks by box."""

import json
from itertools import combinations

import numpy as np
import pytest
import torch
import transformers
from safetensors.torch import load_file, save_file
from tests.perception.segmentation import tiny_models
from tests.perception.segmentation.backends import PHRASES, scene
from tests.perception.segmentation.test_sam3 import count_calls

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation.grounded_sam2 import GroundedSam2Segmenter
from lerobot_openspm.perception.segmentation.instances import DUPLICATE_OVERLAP


@pytest.fixture(scope="module")
def detector():
    return tiny_models.grounding_dino()


@pytest.fixture(scope="module")
def masks():
    return tiny_models.sam2()


@pytest.fixture(scope="module")
def views():
    return scene()


def make(detector, masks, min_confidence):
    return GroundedSam2Segmenter(
        detector.model, detector.processor, masks.model, masks.processor, min_confidence
    )


def test_masks_are_sought_once_an_image_and_only_where_there_are_boxes(detector, masks, views, monkeypatch):
    encoded = count_calls(monkeypatch, masks.model, "get_image_embeddings")
    detected = count_calls(monkeypatch, detector.model, "forward")
    make(detector, masks, 0.0).segment(views, (*PHRASES, "mug"))
    assert len(encoded) == len(views)
    assert len(detected) == 3 * len(views)
    make(detector, masks, 1.0).segment(views, PHRASES)
    assert len(encoded) == len(views)


def test_the_masks_are_those_of_the_boxes(detector, masks, views):
    view = views["front"]
    found = make(detector, masks, 0.0).segment({"front": view}, ["red cup"])["red cup"]["front"]
    inputs = detector.processor(images=view.image, text="red cup.", return_tensors="pt")
    with torch.inference_mode():
        output = detector.model(**inputs)
        (boxes,) = detector.processor.post_process_grounded_object_detection(
            output, inputs.input_ids, 0.0, target_sizes=[view.image.shape[:2]]
        )
        best = int(boxes["scores"].argmax())
        box = boxes["boxes"][best].clamp(min=0).clamp(max=view.image.shape[0])
        prompt = masks.processor(images=view.image, input_boxes=[[box.tolist()]], return_tensors="pt")
        sizes = prompt.pop("original_sizes")
        output = masks.model(**prompt, multimask_output=False)
        (expected,) = masks.processor.post_process_masks(output.pred_masks, sizes)
    np.testing.assert_array_equal(found[0].mask, expected[0, 0].numpy())
    assert found[0].confidence == pytest.approx(float(boxes["scores"][best]))


def test_one_instance_a_place(detector, masks, views):
    for instances in make(detector, masks, 0.0).segment(views, ["cup"])["cup"].values():
        assert len(instances) > 1
        for one, other in combinations(instances, 2):
            assert (one.mask & other.mask).sum() < DUPLICATE_OVERLAP * (one.mask | other.mask).sum()


def test_case_and_full_stops_do_not_matter(detector, masks, views):
    segmenter = make(detector, masks, 0.0)
    found = segmenter.segment(views, ["red cup", "Red  Cup."])
    for camera in views:
        plain, other = found["red cup"][camera], found["Red  Cup."][camera]
        assert [one.confidence for one in plain] == [one.confidence for one in other]


def test_a_phrase_of_too_many_words_is_refused(detector, masks, views):
    with pytest.raises(PerceptionError, match="has 43 tokens, Grounding DINO takes 32; shorten it"):
        make(detector, masks, 0.0).segment(views, ["cup " * 40])


@pytest.fixture
def saved(detector, masks, tmp_path):
    for name, tiny in (("detector", detector), ("masks", masks)):
        tiny.model.save_pretrained(tmp_path / name)
        tiny.processor.save_pretrained(tmp_path / name)
    return tmp_path


def test_saved_checkpoints_see_the_same(detector, masks, views, saved):
    loaded = GroundedSam2Segmenter.from_pretrained(str(saved / "detector"), str(saved / "masks"))
    loaded._min_confidence = 0.0
    again = loaded.segment(views, ["cup"])["cup"]["side"]
    before = make(detector, masks, 0.0).segment(views, ["cup"])["cup"]["side"]
    assert [one.confidence for one in again] == pytest.approx([one.confidence for one in before])


def test_the_mask_models_weights_may_be_part_of_a_video_model(masks, saved):
    """As they are published: with the video model's config, beside the weights of its memory."""
    weights = load_file(saved / "masks/model.safetensors")
    more = weights | {"memory_attention.layers.0.x": torch.zeros(2)}
    save_file(more, saved / "masks/model.safetensors", metadata={"format": "pt"})
    parts = ("vision_config", "prompt_encoder_config", "mask_decoder_config")
    config = {name: getattr(masks.model.config, name).to_dict() for name in parts}
    transformers.Sam2VideoConfig(**config).save_pretrained(saved / "masks")
    assert json.loads((saved / "masks/config.json").read_text())["model_type"] == "sam2_video"
    segmenter = GroundedSam2Segmenter.from_pretrained(str(saved / "detector"), str(saved / "masks"))
    loaded = segmenter._mask_model.state_dict()
    assert all(torch.equal(loaded[key], value) for key, value in weights.items())


@pytest.mark.parametrize("part", ["detector", "masks"])
def test_a_checkpoint_that_lacks_weights_is_refused(saved, part):
    file = saved / part / "model.safetensors"
    weights = load_file(file)
    gone = sorted(weights)[-1]
    save_file({key: value for key, value in weights.items() if key != gone}, file, metadata={"format": "pt"})
    with pytest.raises(PerceptionError, match=f"{part}' lacks 1 weights .*: {gone}; the model would be rand"):
        GroundedSam2Segmenter.from_pretrained(str(saved / "detector"), str(saved / "masks"))
