"""A server that answers, slowly, wrongly, or not at all."""

import json
import logging
import socket
import ssl
import time

import numpy as np
import pytest
from tests.mining.phase_labels.loopback_chat import LoopbackChat, Reply, completion, question_of, say
from tests.mining.phase_labels.questions import PHASES, pick_and_place

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.mining.phase_labels.base import PhaseJudge
from lerobot_openspm.mining.phase_labels.endpoint import (
    API_KEY_VARIABLE,
    MAX_ANSWER_BYTES,
    ChatEndpoint,
    endpoint_judge,
)

KEY = "sk-very-secret"
N = len(PHASES)


def judge(api_base: str, timeout_s: float = 10.0) -> PhaseJudge:
    return endpoint_judge(ChatEndpoint(api_base, "tiny-vl", timeout_s, backoff_s=0.0))


def asked(answer, timeout_s: float = 10.0):
    """What a judge makes of a server's answer, and the server."""
    with LoopbackChat(answer).running() as chat:
        return judge(chat.api_base, timeout_s).judge(pick_and_place()), chat


def sensible(request) -> Reply:
    """Knows phases from the trajectory alone, as a model might."""
    candidates = question_of(request)["candidates"]
    closing = [c["closing"] for c in candidates]
    changes = [i for i in range(1, len(closing)) if closing[i] != closing[i - 1]]
    phases = [
        "approach" if i < changes[0] else "lift" if i < changes[1] else "retreat" for i in range(len(closing))
    ]
    phases[changes[0]], phases[changes[1]] = "grasp", "release"
    return Reply(say(phases))


def test_a_server_that_answers():
    answers, chat = asked(sensible)
    assert [a.phase for a in answers] == ["approach"] * 2 + ["grasp"] + ["lift"] * 3 + ["release", "retreat"]
    assert {a.confidence for a in answers} == {0.9}
    assert len(chat.requests) == 1


def test_the_root_certificates_are_read_once_and_not_within_the_timeout(monkeypatch: pytest.MonkeyPatch):
    read, original = [], ssl.create_default_context

    def slow(*args, **options) -> ssl.SSLContext:
        read.append(args)
        time.sleep(1.5)
        return original(*args, **options)

    monkeypatch.setattr(ssl, "create_default_context", slow)
    with LoopbackChat(sensible).running() as chat:
        asking = judge(chat.api_base, timeout_s=1.0)
        for _ in range(2):
            assert asking.judge(pick_and_place()) is not None
    assert len(read) == 1


def test_what_is_sent(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv(API_KEY_VARIABLE, raising=False)
    _, chat = asked(sensible)
    request, content = chat.requests[0], chat.requests[0]["messages"][0]["content"]
    assert (request["model"], request["temperature"]) == ("tiny-vl", 0)
    schema = request["response_format"]["json_schema"]["schema"]["properties"]["phases"]
    assert schema["minItems"] == schema["maxItems"] == N
    assert [part["text"] for part in content if part["type"] == "text"][:3] == [
        "Camera front:", "Camera side:", "Camera wrist:",
    ]  # fmt: skip
    pictures = [part["image_url"]["url"] for part in content if part["type"] == "image_url"]
    assert len(pictures) == 3
    assert all(url.startswith("data:image/jpeg;base64,") for url in pictures)
    told = question_of(request)
    assert [c["candidate"] for c in told["candidates"]] == list(range(1, N + 1))
    assert set(told["candidates"][0]) == {"candidate", "time_s", "position", "rotation", "opening", "closing"}
    assert "put the bowl on the plate" in content[-1]["text"]
    assert "kinematic" not in json.dumps(request)
    assert "Authorization" not in chat.headers[0]


def test_pictures_arrive_as_they_are():
    import base64

    import cv2

    _, chat = asked(sensible)
    url = chat.requests[0]["messages"][0]["content"][1]["image_url"]["url"]
    jpeg = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
    picture = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[:, :, ::-1]
    (sheet,) = pick_and_place().sheets["observation.images.front"]
    assert picture.shape == sheet.shape
    # JPEG loses some of what is random, but no channel is exchanged for another.
    errors = [np.abs(picture.astype(int) - sheet[:, :, order]).mean() for order in ([0, 1, 2], [2, 1, 0])]
    assert errors[0] < 0.5 * errors[1]


def test_the_key_comes_from_the_environment_and_is_never_told(monkeypatch, caplog):
    monkeypatch.setenv(API_KEY_VARIABLE, KEY)
    caplog.set_level(logging.DEBUG)
    with (
        LoopbackChat(lambda _: Reply(f"wrong key {KEY}".encode(), 401)).running() as chat,
        pytest.raises(PhaseLabelError) as caught,
    ):
        judge(chat.api_base).judge(pick_and_place())
    assert chat.headers[0]["Authorization"] == f"Bearer {KEY}"
    assert "answered with code 401: 'wrong key ***'" in str(caught.value)
    assert KEY not in caplog.text
    assert KEY not in repr(judge("http://127.0.0.1:1/v1"))


@pytest.mark.parametrize(
    ("reply", "words", "requests"),
    [
        (Reply(b"out of memory", 500), "code 500: 'out of memory', 3 times", 3),
        (Reply(b"", 503), "code 503", 3),
        (Reply(b"no such model", 404), "code 404: 'no such model'", 1),
        (Reply(b"\x00\xff garbage"), "gave no chat completion", 1),
        (Reply(b"[" * 200_000), "gave no chat completion", 1),
        (Reply(b'{"choices": []}'), "gave no chat completion", 1),
        (Reply(completion(None)), "a completion without text", 1),
        (Reply(completion("I see a robot.")), "the answer is no JSON", 1),
        (Reply(completion('{"phases": NaN}')), "the answer is no JSON", 1),
        (Reply(completion('{"phases": ' + "[" * 90_000)), "the answer is no JSON", 1),
        (Reply(completion('{"phases": "lift"}')), "'phases' is 'lift', expected a list", 1),
        (Reply(say(["levitate"] * N)), "none of the 8 items in the answer makes sense", 1),
        (Reply(say(["lift"] * N, 7.0)), "none of the 8 items", 1),
        (Reply(completion("x" * (MAX_ANSWER_BYTES + 1))), "more than 1000000 bytes", 1),
        (Reply(say(["lift"] * N), promised=100_000), "could not be asked", 3),
    ],
)
def test_what_is_no_answer_is_one_error(reply: Reply, words: str, requests: int):
    chat = LoopbackChat(lambda _: reply)
    with chat.running(), pytest.raises(PhaseLabelError, match=words):
        judge(chat.api_base).judge(pick_and_place())
    assert len(chat.requests) == requests


@pytest.mark.parametrize(
    "reply",
    [
        Reply(say(["lift"] * N), wait_s=3),
        Reply(say(["lift"] * N), drip_s=0.05),
        Reply(say(["lift"] * N), drip_s=0.05, has_length=False),
        Reply(say(["lift"] * N), head_drip_s=0.05),
    ],
)
def test_a_slow_server_is_waited_for_once_and_no_longer_than_asked(reply: Reply):
    with LoopbackChat(sensible).running() as quick:  # what is imported at the first call is not timed
        judge(quick.api_base).judge(pick_and_place())
    chat = LoopbackChat(lambda _: reply)
    begin = time.monotonic()
    with chat.running(), pytest.raises(PhaseLabelError, match=r"took longer than 0.5 s"):
        judge(chat.api_base, 0.5).judge(pick_and_place())
    assert time.monotonic() - begin < 2.5
    assert len(chat.requests) == 1


def test_a_redirect_is_not_followed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(API_KEY_VARIABLE, KEY)
    with LoopbackChat(sensible).running() as elsewhere:
        there = f"{elsewhere.api_base}/chat/completions"
        with (
            LoopbackChat(lambda _: Reply(b"", 307, location=there)).running() as chat,
            pytest.raises(PhaseLabelError, match="code 307"),
        ):
            judge(chat.api_base).judge(pick_and_place())
    assert (len(chat.requests), elsewhere.requests) == (1, [])


def test_a_server_that_is_gone():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(PhaseLabelError, match=r"could not be asked .*3 times"):
        judge(f"http://127.0.0.1:{port}/v1").judge(pick_and_place())


def test_a_server_that_recovers_is_asked_again():
    replies = iter([Reply(b"busy", 429), Reply(b"", 502), Reply(say(list(PHASES)))])
    answers, chat = asked(lambda _: next(replies))
    assert tuple(a.phase for a in answers) == PHASES
    assert len(chat.requests) == 3


def test_a_server_that_knows_no_schemas_is_asked_without_one_from_then_on():
    def answer(request) -> Reply:
        return Reply(b"response_format?", 400) if "response_format" in request else Reply(say(list(PHASES)))

    with LoopbackChat(answer).running() as chat:
        asking = judge(chat.api_base)
        for _ in range(2):
            assert tuple(a.phase for a in asking.judge(pick_and_place())) == PHASES
    assert ["response_format" in request for request in chat.requests] == [True, False, False]


def test_items_that_make_no_sense_are_no_answers_and_the_others_count():
    items = [
        {"candidate": 1, "phase": "approach", "confidence": 0.8},
        {"candidate": 2, "phase": "fly", "confidence": 0.8},
        {"candidate": 3, "phase": "grasp", "confidence": "high"},
        {"candidate": 4, "phase": "lift", "confidence": True},
        {"candidate": 5, "phase": "lift", "confidence": 10**400},
        {"candidate": 6, "phase": "place", "confidence": 0.9},
        {"candidate": 6, "phase": "lift", "confidence": 0.9},
        {"candidate": 99, "phase": "lift", "confidence": 0.9},
        {"candidate": True, "phase": "lift", "confidence": 0.9},
        "lift",
        {"candidate": 8, "phase": "retreat", "confidence": 1},
    ]
    text = "<think>{is it?}</think>Here it is:\n```json\n" + json.dumps({"phases": items}) + "\n```"
    answers, _ = asked(lambda _: Reply(completion(text)))
    assert [None if a is None else (a.phase, a.confidence) for a in answers] == [
        ("approach", 0.8), None, None, None, None, None, None, ("retreat", 1.0),
    ]  # fmt: skip
