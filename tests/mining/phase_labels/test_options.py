"""The options of the judge, and what a person is told of them."""

from dataclasses import fields

import pytest

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.modeling_openspm import ON_ONE_MACHINE

ENDPOINT = {"phase_judge": "openai", "phase_judge_model_id": "tiny-vl"}


def config(**options) -> OpenSPMConfig:
    return OpenSPMConfig(device="cpu", push_to_hub=False, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"phase_judge": "oracle"}, "phase_judge is 'oracle', expected one of none, openai, qwen3vl"),
        ({"phase_judge": "openai"}, "pass --policy.phase_judge_model_id=NAME"),
        ({"phase_judge_api_base": "http://localhost:8000/v1"}, "is for phase_judge 'openai', got 'none'"),
        ({**ENDPOINT, "phase_judge_api_base": "localhost:8000/v1"}, "no plain http:// or https:// address"),
        ({**ENDPOINT, "phase_judge_api_base": "file:///etc/passwd"}, "no plain http:// or https:// address"),
        ({**ENDPOINT, "phase_judge_api_base": "http://:8000/v1"}, "no plain http:// or https:// address"),
        ({"phase_judge_confidence": 1.5}, "phase_judge_confidence is 1.5, expected 0 to 1"),
        ({"phase_judge_confidence": float("nan")}, "expected 0 to 1"),
        ({"phase_judge_timeout_s": 0.0}, "phase_judge_timeout_s is 0.0, expected more than 0"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict, words: str):
    with pytest.raises(ValueError, match=words):
        config(**options)


@pytest.mark.parametrize("address", ["https://me:secret@host/v1", "https://host/v1?key=secret"])
def test_a_secret_in_an_address_is_refused_and_not_repeated(address: str):
    with pytest.raises(ValueError, match="OPENSPM_JUDGE_API_KEY") as caught:
        config(**ENDPOINT, phase_judge_api_base=address)
    assert "secret" not in str(caught.value)


def test_what_means_nothing_elsewhere_can_be_left_out():
    here = {"phase_judge_api_base": "http://10.0.0.7:8000/v1", "phase_judge_cache": "answers"}
    assert set(here) <= set(ON_ONE_MACHINE) <= {field.name for field in fields(OpenSPMConfig)}
    assert config(**ENDPOINT).phase_judge_api_base is None
    assert config(**ENDPOINT, **here).phase_judge_cache == "answers"
