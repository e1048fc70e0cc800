"""Mined key poses are matched with true events, and demonstrations in a simulator give both."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from benchmarks.key_poses import (
    GOALS,
    KeyPosesConfig,
    Verdict,
    compare,
    goal_things,
    main,
    match,
    summary,
)
from benchmarks.recording import Job, record
from benchmarks.stages import EnvironmentOption

from benchmarks import results
from lerobot_openspm.envs.tabletop.tasks import TASK_NAMES

SEED = 2_900_500


@pytest.mark.parametrize(
    ("mined", "true", "pairs"),
    [
        ([], [5], []),
        ([10, 50], [12, 53], [(0, 0), (1, 1)]),
        ([10], [14], []),
        ([10, 12], [13], [(1, 0)]),
        # The nearest pair first would leave the other two alone.
        ([10, 13], [12, 15], [(0, 0), (1, 1)]),
        ([10, 11, 40], [11, 80], [(1, 0)]),
    ],
)
def test_frames_are_paired_one_to_one_within_the_tolerance(mined, true, pairs):
    assert match(mined, true, 3) == pairs


def test_the_summary_counts_what_was_missed_and_what_was_made_up():
    verdicts = [
        Verdict("grasp", 2, 1, (1.0,), (0,)),
        Verdict("place", 0, 1, (), ()),
        Verdict("place", 1, 1, (3.0,), (2,)),
    ]
    found = summary(verdicts)
    assert list(found)[:3] == ["f1_3_frames", "position_mm_mean", "n"]
    assert found["f1_3_frames"] == pytest.approx(2 * 2 / 6, abs=1e-4)
    assert (found["position_mm_mean"], found["n"], found["frames_mean"]) == (2.0, 3, 1.0)
    assert summary([])["f1_3_frames"] is None


def test_every_task_is_about_something():
    assert goal_things("bowl_in_top_drawer") == GOALS["bowl", "top", "drawer"]
    assert goal_things("open_the_top_drawer_and_put_the_bowl_inside") == GOALS["bowl", "top", "drawer"]
    assert goal_things("put_the_cream_cheese_in_the_bowl") == ("cheese",)
    assert all(goal_things(task) for task in TASK_NAMES)


def test_recordings_hold_the_truth():
    job = Job("openspm_tabletop", "turn_on_stove", SEED)
    recording = record(job)
    assert recording.job == job
    assert recording.instruction == "turn on the stove"
    assert recording.state.dtype == recording.action.dtype == np.float32
    np.testing.assert_allclose(recording.state[:, :3], recording.T_world_ee[:, :3, 3], atol=1e-6)
    (knob,) = [track for track in recording.tracks if track.name == "knob"]
    assert knob.kind == "hinge"
    assert knob.squeezed.any()
    (verdicts,) = compare([recording])
    assert {v.phase: (v.mined, v.true) for v in verdicts if v.true} == {
        "grasp": (1, 1), "turn": (1, 1), "release": (1, 1),
    }  # fmt: skip


def test_key_poses_of_two_tasks_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(results, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    env = EnvironmentOption(task="bowl_on_plate,open_middle_drawer")
    config = KeyPosesConfig(env, episodes=2, seed=SEED, workers=1)
    result = main(config)
    assert result["n"] == 6
    assert result["f1_3_frames"] > 0.8
    assert result["position_mm_mean"] < 5
    assert (tmp_path / "results/keyposes_tabletop.json").is_file()


def test_mistakes_are_told():
    with pytest.raises(ValueError, match="episodes and workers must be at least 1, got 0 and 2"):
        KeyPosesConfig(episodes=0)
    with pytest.raises(ValueError, match=r"env\.type is 'moon', expected openspm_tabletop or libero"):
        EnvironmentOption("moon")


@pytest.mark.skipif(importlib.util.find_spec("libero") is not None, reason="LIBERO is installed")
def test_without_libero_it_is_said_how_to_install_it():
    with pytest.raises(ValueError, match=r"env.type=libero needs LIBERO.*pip install '\.\[libero\]'"):
        EnvironmentOption("libero")


@pytest.mark.libero
def test_libero_gives_both_too():
    pytest.importorskip("libero.libero", reason="needs lerobot[libero]")
    job = Job("libero", "turn_on_the_stove", SEED)
    (verdicts,) = compare([record(job)])
    assert {v.phase: v.true for v in verdicts if v.true} == {"grasp": 1, "turn": 1, "release": 1}
    assert sum(len(v.off_mm) for v in verdicts) >= 2
