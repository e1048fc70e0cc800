"""`openspm bench keyposes`, typed as a user types it."""

import json
from pathlib import Path

from tests.cli.conftest import Openspm

SEED = 2_900_500


def test_key_poses_of_two_tasks_are_measured_and_recordings_kept(openspm: Openspm, tmp_path: Path):
    arguments = (
        "bench", "keyposes", "--env.type=openspm_tabletop", "--env.task=bowl_on_plate,open_middle_drawer",
        "--episodes=2", f"--seed={SEED}", f"--output={tmp_path / 'out'}", "--workers=1",
    )  # fmt: skip
    code, out, err = openspm(*arguments)
    assert code == 0, err
    result = json.loads(out.splitlines()[-1])
    assert list(result)[:3] == ["f1_3_frames", "position_mm_mean", "n"]
    assert result["n"] == 6
    assert result["f1_3_frames"] > 0.8
    assert result["position_mm_mean"] < 5
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "out").iterdir()}
    assert len(before) == 2
    assert json.loads(openspm(*arguments)[1].splitlines()[-1]) == result
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "out").iterdir()} == before
