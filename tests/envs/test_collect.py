import json

import numpy as np
import pytest

from lerobot_openspm.cli.collect import CollectConfig, collect, main
from lerobot_openspm.envs.recording import record_episode
from lerobot_openspm.envs.seeds import DEMO_SEED_START, TUNING_SEED_START
from lerobot_openspm.envs.tasks import TASK_NAMES

ARGUMENTS = ["--task=turn_on_stove", "--episodes=2", "--height=128", "--width=128", "--workers=0"]


def test_collects_a_dataset_that_can_be_opened_again(tmp_path, capsys):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "demos"
    main([*ARGUMENTS, f"--root={root}"])
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(summary) == {"episodes", "frames", "discarded", "root", "seconds"}
    assert not root.with_name("demos.partial").exists()

    dataset = LeRobotDataset("local/openspm_tabletop", root=root)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, summary["frames"], 20)
    records = json.loads((root / "meta/openspm_collect.json").read_text())["episodes"]
    assert [r["seed"] for r in records] == [
        DEMO_SEED_START + 10_000 * TASK_NAMES.index("turn_on_stove") + i for i in (0, 1)
    ]
    episode = record_episode("turn_on_stove", records[0]["seed"], 128, 128)
    frame = dataset[5]
    assert frame["task"] == "turn on the stove"
    np.testing.assert_array_equal(frame["action"], episode.action[5])
    np.testing.assert_array_equal(frame["observation.state"], episode.state[5])
    np.testing.assert_array_equal(frame["simulator.object_poses"], episode.object_poses[5])
    shown = frame["observation.images.front"].numpy().transpose(1, 2, 0) * 255
    assert np.abs(shown - episode.images["front"][5]).mean() < 1.5

    # A complete dataset is left alone.
    before = (root / "meta/info.json").stat().st_mtime_ns
    main([*ARGUMENTS, f"--root={root}"])
    lines = capsys.readouterr().out.splitlines()
    assert "left alone" in lines[-2]
    assert json.loads(lines[-1]) == summary
    assert (root / "meta/info.json").stat().st_mtime_ns == before


def test_a_foreign_folder_is_not_touched(tmp_path):
    (tmp_path / "precious.txt").write_text("keep")
    with pytest.raises(FileExistsError, match="not written by openspm collect"):
        collect(CollectConfig(root=str(tmp_path)))


@pytest.mark.parametrize("seed", [0, 999_999, TUNING_SEED_START])
def test_other_seeds_are_refused(seed):
    with pytest.raises(ValueError, match="demonstration seeds"):
        CollectConfig(seed=seed)
