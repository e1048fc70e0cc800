"""Qwen3-VL in this process writes what its grammar allows and nothing else."""

from pathlib import Path

import pytest
from tests.mining.phase_labels.questions import pick_and_place

from lerobot_openspm.errors import PerceptionError, PhaseLabelError
from lerobot_openspm.memory.entry import PHASES as CLOSED_SET
from lerobot_openspm.mining.phase_labels import qwen3vl
from lerobot_openspm.mining.phase_labels.prompt import Prompt
from lerobot_openspm.mining.phase_labels.qwen3vl import Qwen3VL, qwen3vl_judge


@pytest.fixture(scope="module")
def model(tiny_qwen3vl_parts) -> Qwen3VL:
    return Qwen3VL(*tiny_qwen3vl_parts, "tiny")


QUESTION = pick_and_place(cameras=1, n=2)


def one_of(*alternatives: str):
    return lambda written: () if written else alternatives


def test_phases_are_of_the_closed_set_with_a_confidence_each(model: Qwen3VL):
    answers = qwen3vl_judge(model).judge(pick_and_place(n=3))
    assert len(answers) == 3
    assert all(a.phase in CLOSED_SET and 0 < a.confidence < 1 for a in answers)


def test_the_pictures_are_looked_at(model: Qwen3VL):
    first, other = (qwen3vl_judge(model).judge(pick_and_place(1, episode, n=2)) for episode in (0, 1))
    assert [a.confidence for a in first] != [a.confidence for a in other]


def test_a_question_without_pictures_is_text_alone(model: Qwen3VL):
    assert len(qwen3vl_judge(model).judge(pick_and_place(cameras=0, n=2))) == 2


def test_the_alternatives_probabilities_add_up_to_one(model: Qwen3VL):
    """Their shares as the model itself gives them for the token that tells them apart."""
    import torch

    alternatives = ("ax", "bx", "cx")
    (piece,) = model.write(Prompt("Which?", (), {}), one_of(*alternatives))
    inputs = model._inputs(Prompt("Which?", (), {}))
    with torch.inference_mode():
        logits = model._model(**inputs).logits[0, -1]
    tokens = [model._processor.tokenizer(a)["input_ids"][0] for a in alternatives]
    shares = logits[tokens].float().softmax(dim=0)
    assert piece.text == alternatives[int(shares.argmax())]
    assert piece.probability == pytest.approx(float(shares.max()), rel=1e-4)


def test_what_is_forced_is_certain(model: Qwen3VL):
    (piece,) = model.write(Prompt("Say it.", (), {}), one_of("1: approach\n"))
    assert (piece.text, piece.probability) == ("1: approach\n", 1.0)


def test_a_later_piece_depends_on_what_was_written_before(model: Qwen3VL):
    def grammar(written):
        following = {"no ": ("never", "none"), "yes ": ("always", "all")}
        return following.get(written[-1], ()) if written else tuple(following)

    first, second = model.write(Prompt("?", (), {}), grammar)
    assert second.text in {"no ": ("never", "none"), "yes ": ("always", "all")}[first.text]


def test_nothing_is_computed_after_the_end_of_the_grammar(model: Qwen3VL, monkeypatch: pytest.MonkeyPatch):
    """Although the tiny model's settings, unlike the real one's, name no token that ends an answer."""
    generate, outputs = model._model.generate, []
    monkeypatch.setattr(model._model, "generate", lambda **o: outputs.append(generate(**o)) or outputs[-1])
    model.write(Prompt("Say it.", (), {}), one_of("ab"))
    prompt = model._inputs(Prompt("Say it.", (), {}))["input_ids"]
    spelled = model._processor.tokenizer.decode(outputs[0][0, prompt.shape[1] :])
    assert spelled == "ab<|im_end|>"


def test_a_grammar_without_end_is_an_error(model: Qwen3VL, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(qwen3vl, "MAX_NEW_TOKENS", 12)
    with pytest.raises(PhaseLabelError, match="wrote 12 tokens and came to no end"):
        model.write(Prompt("Go on.", (), {}), lambda written: ("la", "lo"))


def test_it_is_loaded_from_its_files(tiny_qwen3vl_folder: Path, model: Qwen3VL):
    loaded = Qwen3VL.from_pretrained(str(tiny_qwen3vl_folder))
    assert loaded.model_id == str(tiny_qwen3vl_folder)
    for ours, theirs in zip(*(qwen3vl_judge(m).judge(QUESTION) for m in (model, loaded)), strict=True):
        assert (ours.phase, ours.confidence) == (theirs.phase, pytest.approx(theirs.confidence, rel=1e-3))


def test_missing_weights_are_one_error_with_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(PerceptionError, match="hf download Qwen/Qwen3-VL-2B-Instruct"):
        Qwen3VL.from_pretrained()


def test_a_missing_package_is_one_error_with_the_command(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    with pytest.raises(PerceptionError, match=r"pip install 'lerobot_policy_openspm\[perception\]'"):
        Qwen3VL.from_pretrained()


def test_a_device_that_is_too_small_is_a_failure_to_answer(model: Qwen3VL, monkeypatch: pytest.MonkeyPatch):
    import torch

    def full(**_):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(model._model, "generate", full)
    with pytest.raises(PhaseLabelError, match="tiny does not fit"):
        model.write(Prompt("?", (), {}), one_of("a"))
