"""`openspm bench`, typed as a user types it, on the tests' small checkpoint."""

import json
import shutil
from pathlib import Path

import pytest
from tests.cli.conftest import Openspm


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "bench what? got '', expected one of perception, tracking, cameras"),
        (("speed",), "got 'speed'"),
        (
            ("perception", "--policy.path=nowhere"),
            "no checkpoint of this policy at nowhere; pass --policy.path",
        ),
        (("tracking", "--env.type=moon"), "env.type is 'moon', expected one of openspm_tabletop, libero"),
        (("tracking", "--episodes=0"), "episodes and workers must be at least 1"),
    ],
)
def test_mistakes_are_one_line(openspm: Openspm, arguments: tuple[str, ...], message: str):
    code, out, err = openspm("bench", *arguments)
    assert (code, out) == (2, "")
    assert message in err.splitlines()[-1]


def test_a_task_in_which_nothing_can_be_dropped_is_refused(
    openspm: Openspm, checkpoint: Path, tmp_path: Path
):
    code, _, err = openspm(
        "bench", "tracking", f"--policy.path={checkpoint}", "--env.task=turn_on_stove",
        f"--output={tmp_path / 'out'}",
    )  # fmt: skip
    assert code == 2
    assert "nothing can be displaced there, expected some of bowl_on_plate" in err


def test_a_folder_of_somebody_else_is_left_alone(openspm: Openspm, checkpoint: Path, tmp_path: Path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("do not remove")
    code, _, err = openspm(
        "bench", "tracking", f"--policy.path={checkpoint}", f"--output={tmp_path / 'mine'}"
    )
    assert code == 2
    assert "holds something that was not measured here; choose another --output" in err
    assert (tmp_path / "mine" / "precious.txt").read_text() == "do not remove"


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_tracking_is_measured_and_goes_on_where_it_was(
    openspm: Openspm, checkpoint: Path, tmp_path: Path, workers: int
):
    arguments = (
        "bench", "tracking", f"--policy.path={checkpoint}", "--env.task=bowl_on_plate", "--episodes=1",
        "--seed=2000008", f"--workers={workers}", f"--output={tmp_path / 'out'}",
    )  # fmt: skip
    code, out, err = openspm(*arguments)
    assert code == 0, err
    result = json.loads(out.splitlines()[-1])
    assert set(result) == {
        "success_displaced", "success_dropped", "success_displaced_untracked", "success_dropped_untracked",
        "n", "conditions",
    }  # fmt: skip
    assert result["n"] == 1
    log = tmp_path / "out" / "episodes.jsonl"
    lines = log.read_text().splitlines()
    assert len(lines) == 4
    assert all(json.loads(line)["disturbed_at"] is not None for line in lines)
    log.write_text("\n".join(lines[:3]) + '\n{"torn')
    assert json.loads(openspm(*arguments)[1].splitlines()[-1]) == result


@pytest.mark.slow
def test_perception_is_measured(openspm: Openspm, checkpoint: Path, tiny_dataset: Path, tmp_path: Path):
    arguments = (
        "bench", "perception", f"--policy.path={checkpoint}", f"--dataset.root={tiny_dataset}",
        "--env.task=turn_on_stove", "--episodes=1", "--seed=2000000", "--workers=1",
        f"--output={tmp_path / 'out'}",
    )  # fmt: skip
    code, out, err = openspm(*arguments)
    assert code == 0, err
    result = json.loads(out.splitlines()[-1])
    assert 0 < result["position_mm_mean"] <= result["position_mm_p95"] < 30
    assert 0 <= result["orientation_deg_mean"] < 10
    assert 0 < result["filter_us"] < 5000
    assert 0 < result["ms_per_observation"] < 5000
    assert result["n"] == result["variants"]["filtered"]["poses"] > 20
    assert list(result["objects"]) == ["stove"]
    missing = tmp_path / "nothing"
    shutil.rmtree(tmp_path / "out")
    code, _, err = openspm(*arguments[:3], f"--dataset.root={missing}", *arguments[4:])
    assert code == 2
    assert "no demonstrations at" in err
