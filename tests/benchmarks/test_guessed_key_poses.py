"""Key poses that a model makes up are asked for, checked and refused."""

import json
import random

import numpy as np
import pytest
from benchmarks.libero import guessed_key_poses
from benchmarks.libero.guessed_key_poses import (
    SceneQuestion,
    SeenObject,
    check_sequence,
    guess_by_endpoint,
    guess_by_qwen3vl,
    key_pose_grammar,
    read_key_poses,
)
from tests.mining.phase_labels.loopback_chat import LoopbackChat, Reply, completion, question_of

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.mining.phase_labels.endpoint import ChatEndpoint
from lerobot_openspm.mining.phase_labels.qwen3vl import Qwen3VL

BOWL, PLATE = np.array([0.1, -0.2, 0.03]), np.array([0.05, 0.2, 0.01])
QUESTION = SceneQuestion(
    'put the "bowl" on the plate',
    (
        SeenObject("bowl", BOWL, np.array([0.1, 0.1, 0.06]), 0.3),
        SeenObject("plate", PLATE, np.array([0.2, 0.2, 0.02])),
    ),
    np.array([0.0, 0.0, 0.3]),
    0.08,
    {"observation.images.front": np.zeros((32, 48, 3), np.uint8)},
)


def pose(phase: str, position=(0.1, 0.0, 0.2), closed: bool = False, rotation=(0.0, 0.0, 0.0)) -> dict:
    return {"phase": phase, "position": list(position), "rotation": list(rotation), "closed": closed}


def pick_and_place(scene: dict) -> list[dict]:
    """What a sensible model answers, from nothing but the question's JSON."""
    target, goal = (np.array(o["centre"]) for o in scene["objects"])
    up, grip = np.array([0, 0, 0.12]), np.array([0, 0, scene["objects"][0]["size"][2] / 2])
    return [
        pose("approach", target + up),
        pose("approach", target + grip),
        pose("grasp", target + grip, True),
        pose("lift", target + up, True),
        pose("pre-place", goal + up, True),
        pose("place", goal + 2 * grip, True),
        pose("release", goal + 2 * grip),
        pose("retreat", goal + up),
    ]


def test_a_server_that_answers_from_the_question():
    def answer(request) -> Reply:
        return Reply(completion(json.dumps({"key_poses": pick_and_place(question_of(request))})))

    with LoopbackChat(answer).running() as chat:
        guessed = guess_by_endpoint(QUESTION, ChatEndpoint(chat.api_base, "tiny-vl"))
    phases = "approach approach grasp lift pre-place place release retreat"
    assert " ".join(g.phase for g in guessed) == phases
    np.testing.assert_allclose(guessed[2].position - BOWL, [0, 0, 0.03], atol=1e-9)
    np.testing.assert_allclose(guessed[4].position - PLATE, [0, 0, 0.12], atol=1e-9)
    assert [g.closed for g in guessed] == [False, False, True, True, True, True, False, False]
    content = chat.requests[0]["messages"][0]["content"]
    assert [part["type"] for part in content] == ["text", "image_url", "text"]
    scene = question_of(chat.requests[0])
    assert scene["gripper_opens"] == 0.08
    assert scene["objects"][0] == {
        "name": "bowl",
        "centre": [0.1, -0.2, 0.03],
        "size": [0.1, 0.1, 0.06],
        "yaw": 0.3,
    }
    assert "response_format" in chat.requests[0]


GOOD = [pose("approach"), pose("grasp", closed=True), pose("turn", closed=True), pose("release")]


def changed(i: int, **fields) -> dict:
    poses = [dict(p) for p in GOOD]
    poses[i].update(fields)
    return {"key_poses": poses}


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ({"key_poses": []}, "expected an object with 2 to 32"),
        ({"key_poses": GOOD, "note": "careful"}, "and nothing else"),
        ({"key_poses": [pose("approach")] * 33}, "2 to 32"),
        ({"poses": GOOD}, "2 to 32"),
        ({"key_poses": [*GOOD, "retreat"]}, r"key_poses\[4\] is no object"),
        (changed(1, force=3.0), r"key_poses\[1\] is no object"),
        (changed(0, phase="fly"), "phase is 'fly'"),
        (changed(0, phase=["approach"]), "phase is"),
        (changed(1, closed=False), "closed is 'False', which does not go with 'grasp'"),
        (changed(1, closed=1), "closed is '1'"),
        (changed(0, position=[0.1, 0.2]), "expected three numbers"),
        (changed(0, position="here"), "expected three numbers"),
        (changed(0, position=[0.1, 0.2, True]), "expected three numbers"),
        (changed(0, position=[0.1, 0.2, None]), "expected three numbers"),
        (changed(0, position=[0.1, 0.2, 10**400]), "too large"),
        (changed(0, position=[0.1, 0.2, 3.0]), "expected within 2.0 m"),
        (changed(0, position=[0.1, 0.2, 1e308]), "expected within 2.0 m"),
        (changed(2, rotation=[0.0, 0.0, 4.0]), "expected up to half a turn"),
        (changed(1, phase="release", closed=False), "phase 2 is 'release' after 'approach'"),
        (changed(3, phase="turn", closed=True), "phase 4 is 'turn' after 'turn'"),
    ],
)
def test_what_is_malformed_or_cannot_be_followed_is_refused(answer: dict, words: str):
    assert len(read_key_poses(json.dumps({"key_poses": GOOD}))) == 4
    with pytest.raises(PhaseLabelError, match=words):
        read_key_poses(json.dumps(answer))


@pytest.mark.parametrize(
    "text", ["", "no", "[1]", '{"key_poses": [NaN, Infinity]}', '{"key_poses": ' + "[" * 99_999]
)
def test_what_is_no_json_is_refused(text: str):
    with pytest.raises(PhaseLabelError, match="the answer is no JSON"):
        read_key_poses(text)


@pytest.mark.parametrize("seed", range(30))
def test_whatever_the_grammar_allows_is_taken(seed: int):
    rng, written = random.Random(seed), ()
    while alternatives := key_pose_grammar(written):
        written = (*written, rng.choice(alternatives))
        assert len(written) < 1000
    assert len(read_key_poses("".join(written))) >= 2


def test_qwen3vl_makes_up_key_poses_that_can_be_followed(monkeypatch: pytest.MonkeyPatch):
    from tests.mining.phase_labels import tiny_qwen3vl  # imports transformers, which takes seconds

    processor = tiny_qwen3vl.processor()
    model = Qwen3VL(tiny_qwen3vl.model(processor.tokenizer), processor, "tiny")
    monkeypatch.setattr(guessed_key_poses, "_ENOUGH", 2)  # it knows no end of its own
    guessed = guess_by_qwen3vl(QUESTION, model)
    assert guessed[0].phase == "approach"
    assert all(np.isfinite(g.position).all() for g in guessed)


@pytest.mark.parametrize(
    ("walk", "words"),
    [
        ("grasp lift", "first phase is 'grasp', expected approach"),
        ("approach release", "phase 2 is 'release' after 'approach', expected approach or grasp or push"),
        ("approach grasp place", "last phase is 'place'"),
    ],
)
def test_sequences_that_no_hand_can_follow_are_named(walk: str, words: str):
    with pytest.raises(PhaseLabelError, match=words):
        check_sequence(walk.split())
