import json
import logging
from pathlib import Path

import pytest

from lerobot_openspm.cli.demo import EVALUATION_SEED
from lerobot_openspm.cli.pipeline import Episode, digest, discard_unless, mean_steps, rate, read_episodes
from lerobot_openspm.envs.seeds import EVALUATION_SEEDS, seed_purpose


def line(**changes: object) -> str:
    return json.dumps(
        {"task": "push_plate", "seed": 7, "steps": 80, "success": True, "status": "success", **changes}
    )


def test_rates_come_with_wilsons_interval():
    # The textbook case: 95 of 100 gives 0.888 to 0.978.
    assert rate(95, 100) == {"success": 0.95, "n": 100, "interval": [0.8882, 0.9785]}


def test_the_log_is_read_by_task_and_seed(tmp_path: Path):
    log = tmp_path / "episodes.jsonl"
    assert read_episodes(log, range(10)) == []
    log.write_text("\n".join([line(success=False, status="time_limit"), line(), line(seed=99)]) + "\n")
    # The same episode run again after an interruption counts once, as it went last.
    assert read_episodes(log, range(10)) == [Episode("push_plate", 7, 80, True, "success")]


def test_mean_steps_are_those_of_successes():
    won, lost = Episode("a", 0, 80, True, "success"), Episode("a", 1, 300, False, "time_limit")
    assert mean_steps([won, lost]) == 80
    assert mean_steps([lost]) != mean_steps([lost])  # NaN


def test_a_result_is_kept_only_for_what_it_was_made_of(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    weights, output = tmp_path / "weights", tmp_path / "run" / "eval"
    weights.write_bytes(b"one")
    made_of = digest([weights], ["--policy.execution=open_loop"])
    discard_unless(output, made_of)
    output.mkdir()
    (output / "kept").touch()
    discard_unless(output, made_of)
    assert (output / "kept").exists()
    weights.write_bytes(b"two")
    with caplog.at_level(logging.INFO):
        discard_unless(output, digest([weights], ["--policy.execution=open_loop"]))
    assert not output.exists()
    assert "made of something else" in caplog.text
    assert digest([weights], []) != digest([weights], ["--a"])


def test_the_demo_is_evaluated_on_evaluation_seeds():
    assert {seed_purpose(seed) for seed in (EVALUATION_SEED, EVALUATION_SEED + 499)} == {"evaluation"}
    assert EVALUATION_SEED in EVALUATION_SEEDS
