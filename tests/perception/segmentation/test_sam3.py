"""SAM 3's backend: what it computes how often, and checkpoints that it has to refuse."""

import json

import numpy as np
import pytest
import torch
import transformers
from safetensors.torch import load_file, save_file
from tests.perception.segmentation import tiny_models
from tests.perception.segmentation.backends import PHRASES, scene

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation.instances import distinct_instances
from lerobot_openspm.perception.segmentation.sam3 import Sam3Segmenter


@pytest.fixture(scope="module")
def tiny():
    return tiny_models.sam3()


@pytest.fixture(scope="module")
def views():
    return scene()


@pytest.fixture
def saved(tiny, tmp_path):
    """A checkpoint to spoil."""
    tiny.model.save_pretrained(tmp_path)
    tiny.processor.save_pretrained(tmp_path)
    return tmp_path


def count_calls(monkeypatch, model, name):
    calls, original = [], getattr(model, name)

    def counted(*args, **kwargs):
        calls.append(name)
        return original(*args, **kwargs)

    monkeypatch.setattr(model, name, counted)
    return calls


def test_an_image_is_encoded_once_and_a_phrase_once(tiny, views, monkeypatch):
    images = count_calls(monkeypatch, tiny.model, "get_vision_features")
    texts = count_calls(monkeypatch, tiny.model, "get_text_features")
    encoder = count_calls(monkeypatch, tiny.model.vision_encoder, "forward")
    Sam3Segmenter(tiny.model, tiny.processor).segment(views, (*PHRASES, "mug", "cup"))
    assert len(images) == len(encoder) == len(views) == 2
    assert len(texts) == 3


def test_the_masks_are_the_models_own(tiny, views):
    found = Sam3Segmenter(tiny.model, tiny.processor, 0.0).segment(views, ["red cup"])["red cup"]
    for camera, view in views.items():
        inputs = tiny.processor(images=view.image, text="red cup", return_tensors="pt")
        sizes = inputs.pop("original_sizes").tolist()
        with torch.inference_mode():
            output = tiny.model(**inputs)
        (result,) = tiny.processor.post_process_instance_segmentation(output, 0.0, target_sizes=sizes)
        expected = distinct_instances(result["masks"].numpy() > 0, result["scores"].double().numpy())
        assert len(found[camera]) == len(expected) > 0
        for one, other in zip(found[camera], expected, strict=True):
            np.testing.assert_array_equal(one.mask, other.mask)
            assert one.confidence == pytest.approx(other.confidence)


def test_what_is_less_sure_is_left_out(tiny, views):
    everything = Sam3Segmenter(tiny.model, tiny.processor, 0.0).segment(views, ["cup"])["cup"]["front"]
    between = (everything[0].confidence + everything[1].confidence) / 2
    (one,) = Sam3Segmenter(tiny.model, tiny.processor, between).segment(views, ["cup"])["cup"]["front"]
    assert one.confidence == everything[0].confidence


def test_a_phrase_of_too_many_words_is_refused(tiny, views):
    with pytest.raises(PerceptionError, match="has 42 tokens, SAM 3 takes 32; shorten it"):
        Sam3Segmenter(tiny.model, tiny.processor).segment(views, ["cup " * 40])


def test_a_saved_checkpoint_sees_the_same(tiny, views, saved):
    loaded = Sam3Segmenter.from_pretrained(str(saved))
    loaded._min_confidence = 0.0
    again = loaded.segment(views, ["cup"])["cup"]["side"]
    before = Sam3Segmenter(tiny.model, tiny.processor, 0.0).segment(views, ["cup"])["cup"]["side"]
    assert [one.confidence for one in again] == pytest.approx([one.confidence for one in before])
    assert not loaded._model.training


def test_the_weights_may_be_part_of_a_video_model(tiny, saved):
    """As they are published: under a prefix, beside those of a tracker, with the video model's config."""
    weights = load_file(saved / "model.safetensors")
    renamed = {f"detector_model.{key}": value for key, value in weights.items()}
    save_file(renamed | {"tracker_model.x": torch.zeros(2)}, saved / "model.safetensors", {"format": "pt"})
    config = transformers.Sam3VideoConfig(detector_config=tiny.model.config.to_dict())
    config.save_pretrained(saved)
    assert json.loads((saved / "config.json").read_text())["model_type"] == "sam3_video"
    loaded = Sam3Segmenter.from_pretrained(str(saved))._model.state_dict()
    assert all(torch.equal(loaded[key], value) for key, value in weights.items())


def spoil(saved, change):
    weights = change(load_file(saved / "model.safetensors"))
    save_file(weights, saved / "model.safetensors", metadata={"format": "pt"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda w: {k: v for k, v in w.items() if not k.endswith("text_model.final_layer_norm.bias")},
            r"lacks 1 weights .*: text_encoder\.text_model\.final_layer_norm\.bias; the model would be r",
        ),
        (
            lambda w: {k: v for k, v in w.items() if not k.startswith("text_encoder.")},
            r"lacks \d\d weights that transformers 5.*: text_encoder\.text_.* and \d+ more; .*transformers==",
        ),
        (
            lambda w: {k.replace("text_encoder.text_model.", "text_encoder."): v for k, v in w.items()},
            r"lacks \d\d weights .*text_encoder\.text_model",
        ),
        (
            lambda w: w | {"text_projection.bias": torch.zeros(7)},
            r"has in another shape 1 weights .*text_projection\.bias",
        ),
    ],
    ids=["one is missing", "no text encoder", "the text encoder under another name", "another shape"],
)
def test_a_checkpoint_that_fills_the_model_in_part_is_refused(saved, change, message):
    Sam3Segmenter.from_pretrained(str(saved))
    spoil(saved, change)
    with pytest.raises(PerceptionError, match=message):
        Sam3Segmenter.from_pretrained(str(saved))
