"""`openspm bench`, typed as a user types it, on the tests' small checkpoint."""

import json
from pathlib import Path

import pytest
from tests.cli.conftest import Openspm

from lerobot_openspm.cli.bench import COMMANDS


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)])
def test_it_lists_what_it_measures(openspm: Openspm, arguments: tuple[str, ...]):
    code, out, _ = openspm("bench", *arguments)
    assert code == 0
    assert "usage: openspm bench COMMAND" in out
    assert all(f"  {name} " in out for name in COMMANDS)


def test_a_measure_lists_its_options_under_its_name(openspm: Openspm):
    code, out, _ = openspm("bench", "latency", "--help")
    assert code == 0
    assert out.startswith("usage: openspm bench latency [-h]")
    assert "--dataset.root" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("speed",), "unknown command 'speed'; expected one of latency"),
        (("latency", "--policy.path=x", "--threads=0"), "threads and repeats must be at least 1, got 0"),
        (("latency", "--policy.path=nowhere"), "no checkpoint of this policy at nowhere"),
    ],
)
def test_mistakes_are_one_line(openspm: Openspm, arguments: tuple[str, ...], message: str):
    code, out, err = openspm("bench", *arguments)
    assert (code, out) == (2, "")
    assert message in err.splitlines()[-1]


def test_the_time_of_decisions_is_measured_on_a_frame_of_a_dataset(
    openspm: Openspm, checkpoint: Path, tiny_dataset: Path
):
    arguments = (
        "bench", "latency", f"--policy.path={checkpoint}", f"--dataset.root={tiny_dataset}", "--repeats=3"
    )  # fmt: skip
    code, out, err = openspm(*arguments)
    assert code == 0, err
    measured = json.loads(out.splitlines()[-1])
    assert measured["instruction"] == "put the bowl on the plate"
    assert 0 < measured["chunk_ms"]["median"] <= measured["chunk_ms"]["p99"]
    assert measured["chunk_ms"]["median"] < measured["first_action_ms"]["median"]
    assert (measured["chunk_ms"]["n"], measured["first_action_ms"]["n"]) == (30, 3)
    code, _, err = openspm(*arguments, "--instruction=juggle the knives")
    assert code == 2
    assert "the policy does not act on 'juggle the knives'" in err.splitlines()[-1]
    code, _, err = openspm(*arguments[:3], "--dataset.root=nowhere")
    assert code == 2
    assert "pass --dataset.root=FOLDER" in err.splitlines()[-1]
