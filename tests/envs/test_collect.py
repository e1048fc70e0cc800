import dataclasses
import json

import numpy as np
import pytest

from lerobot_openspm.cli.collect import main
from lerobot_openspm.envs import collection
from lerobot_openspm.envs.collection import CollectConfig, SimulatorConfig, collect
from lerobot_openspm.envs.recording import RecordedEpisode, record
from lerobot_openspm.envs.seeds import DEMO_SEED_START, TUNING_SEED_START
from lerobot_openspm.envs.tabletop.recording import Tabletop
from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES

ARGUMENTS = ["--env.task=turn_on_stove", "--episodes=2", "--height=128", "--width=128", "--workers=0"]


def stove_episode(seed: int) -> RecordedEpisode:
    scene = Tabletop().scene("turn_on_stove", 128, 128)
    episode = record(scene, "turn_on_stove", seed)
    scene.close()
    return episode


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
    episode = stove_episode(records[0]["seed"])
    frame = dataset[5]
    assert frame["task"] == "turn on the stove"
    np.testing.assert_array_equal(frame["action"], episode.columns["action"][5])
    np.testing.assert_array_equal(frame["observation.state"], episode.columns["observation.state"][5])
    np.testing.assert_array_equal(
        frame["simulator.object_poses"], episode.columns["simulator.object_poses"][5]
    )
    shown = frame["observation.images.front"].numpy().transpose(1, 2, 0) * 255
    assert np.abs(shown - episode.images["front"][5]).mean() < 1.5

    # A complete dataset is left alone.
    before = (root / "meta/info.json").stat().st_mtime_ns
    main([*ARGUMENTS, f"--root={root}"])
    lines = capsys.readouterr().out.splitlines()
    assert "left alone" in lines[-2]
    assert json.loads(lines[-1]) == summary
    assert (root / "meta/info.json").stat().st_mtime_ns == before


def test_an_interrupted_recording_goes_on_where_it_stopped(tmp_path, monkeypatch):
    root, part = tmp_path / "demos", tmp_path / "demos.partial/turn_on_stove"
    env = SimulatorConfig(task="turn_on_stove,bowl_on_plate")
    config = CollectConfig(env, 1, str(root), height=128, width=128, workers=0)

    def interrupted(scene, task, seed):
        if task == "bowl_on_plate":
            raise KeyboardInterrupt
        return record(scene, task, seed)

    monkeypatch.setattr(collection, "record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        collect(config)
    assert (part / "meta/info.json").is_file()
    assert not root.exists()

    def only_the_rest(scene, task, seed):
        assert task == "bowl_on_plate"
        return record(scene, task, seed)

    monkeypatch.setattr(collection, "record", only_the_rest)
    assert collect(config)["episodes"] == 2
    assert not part.parent.exists()
    recorded = json.loads((root / "meta/openspm_collect.json").read_text())
    assert [e["task"] for e in recorded["episodes"]] == ["turn_on_stove", "bowl_on_plate"]


def test_an_interrupted_task_goes_on_with_the_next_episode(tmp_path, monkeypatch):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root, seeds = tmp_path / "demos", []
    config = CollectConfig(
        SimulatorConfig(task="turn_on_stove"), 2, str(root), height=128, width=128, workers=0
    )

    def interrupted_once(scene, task, seed):
        seeds.append(seed)
        if len(seeds) == 2:
            raise KeyboardInterrupt
        return record(scene, task, seed)

    monkeypatch.setattr(collection, "record", interrupted_once)
    with pytest.raises(KeyboardInterrupt):
        collect(config)
    assert collect(config)["episodes"] == 2
    first = seeds[0]
    assert seeds == [first, first + 1, first + 1]
    recorded = json.loads((root / "meta/openspm_collect.json").read_text())
    assert [e["seed"] for e in recorded["episodes"]] == [first, first + 1]

    dataset = LeRobotDataset("local/openspm_tabletop", root=root)
    assert dataset.num_episodes == 2
    for number, seed in enumerate((first, first + 1)):
        frame = dataset[dataset.meta.episodes[number]["dataset_from_index"] + 5]
        episode = stove_episode(seed)
        assert frame["episode_index"] == number
        np.testing.assert_array_equal(frame["action"], episode.columns["action"][5])
        shown = frame["observation.images.front"].numpy().transpose(1, 2, 0) * 255
        assert np.abs(shown - episode.images["front"][5]).mean() < 1.5


@pytest.mark.slow  # each process imports LeRobot
def test_two_processes_record_what_one_does(tmp_path, tiny_dataset):
    def recorded(root):
        return json.loads((root / "meta/openspm_collect.json").read_text())["episodes"]

    env = SimulatorConfig(task="turn_on_stove,bowl_on_plate")
    collect(CollectConfig(env, 1, str(tmp_path / "two"), height=128, width=128, workers=2))
    stove, bowl = recorded(tmp_path / "two")
    assert [stove["task"], bowl["task"]] == ["turn_on_stove", "bowl_on_plate"]
    # One process has recorded three of each, the bowl first.
    assert [bowl, stove] == recorded(tiny_dataset)[::3]


def test_a_foreign_partial_folder_is_not_touched(tmp_path):
    foreign = tmp_path / "demos.partial"
    foreign.mkdir()
    (foreign / "precious.txt").write_text("keep")
    with pytest.raises(FileExistsError, match="not written by openspm collect"):
        collect(CollectConfig(root=str(tmp_path / "demos")))
    assert (foreign / "precious.txt").exists()


def test_a_broken_expert_stops_the_recording(tmp_path, monkeypatch):
    failed = dataclasses.replace(stove_episode(DEMO_SEED_START), status="time_limit")
    monkeypatch.setattr(collection, "record", lambda *_: failed)
    root = tmp_path / "demos"
    with pytest.raises(RuntimeError, match="failed 4 times on turn_on_stove"):
        collect(
            CollectConfig(
                SimulatorConfig(task="turn_on_stove"), 1, str(root), height=128, width=128, workers=0
            )
        )
    assert not root.exists()


def test_a_foreign_folder_is_not_touched(tmp_path):
    (tmp_path / "precious.txt").write_text("keep")
    with pytest.raises(FileExistsError, match="not written by openspm collect"):
        collect(CollectConfig(root=str(tmp_path)))


@pytest.mark.parametrize("seed", [0, 999_999, TUNING_SEED_START])
def test_other_seeds_are_refused(seed):
    with pytest.raises(ValueError, match="demonstration seeds"):
        CollectConfig(seed=seed)
