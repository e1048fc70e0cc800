"""The options of the judge, and what a person is told of them."""

from typing import Any

import pytest

from lerobot_openspm.configuration_openspm import JudgeConfig, OpenSPMConfig

ENDPOINT = {"type": "openai", "model_id": "tiny-vl"}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"type": "oracle"}, "judge.type is 'oracle', expected one of none, openai, qwen3vl"),
        ({"type": "openai"}, "pass --policy.judge.model_id=NAME"),
        ({"api_base": "http://localhost:8000/v1"}, "is for judge.type 'openai', got 'none'"),
        ({**ENDPOINT, "api_base": "localhost:8000/v1"}, "no plain http:// or https:// address"),
        ({**ENDPOINT, "api_base": "file:///etc/passwd"}, "no plain http:// or https:// address"),
        ({**ENDPOINT, "api_base": "http://:8000/v1"}, "no plain http:// or https:// address"),
        ({"confidence": 1.5}, "judge.confidence is 1.5, expected 0 to 1"),
        ({"confidence": float("nan")}, "expected 0 to 1"),
        ({"timeout_s": 0.0}, "judge.timeout_s is 0.0, expected more than 0"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict[str, Any], words: str):
    with pytest.raises(ValueError, match=words):
        JudgeConfig(**options)


@pytest.mark.parametrize("address", ["https://me:secret@host/v1", "https://host/v1?key=secret"])
def test_a_secret_in_an_address_is_refused_and_not_repeated(address: str):
    with pytest.raises(ValueError, match="OPENSPM_JUDGE_API_KEY") as caught:
        JudgeConfig(**ENDPOINT, api_base=address)
    assert "secret" not in str(caught.value)


def test_the_address_is_not_saved():
    judge = JudgeConfig(**ENDPOINT, api_base="http://10.0.0.7:8000/v1")
    saved = OpenSPMConfig(device="cpu", push_to_hub=False, judge=judge).without_places()
    assert saved.judge == JudgeConfig(**ENDPOINT)
