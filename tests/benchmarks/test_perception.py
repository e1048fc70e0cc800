"""Poses along episodes against the simulator's, on the tests' small checkpoint."""

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks.perception import PerceptionConfig, look_ms, main

from benchmarks import results
from lerobot_openspm.errors import DatasetError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.perception.objects.base import Look
from lerobot_openspm.perception.observation import Observation
from lerobot_openspm.types import Hand, PoseEstimate


@dataclass
class Known:
    """An object that is always found, and notes with how many views and whether it was expected."""

    name: str
    sought: list[tuple[int, bool]] = field(default_factory=list)
    points = np.zeros((0, 3))
    sought_again = False

    def localise(self, look: Look) -> PoseEstimate:
        self.sought.append((len(look.views), self.name in look.expected))
        return PoseEstimate("found", np.eye(4), 1e-6 * np.eye(4), 0.99)


@dataclass
class Memory:
    """A memory of four objects, of which a task needs the last two."""

    cameras: dict[str, Camera]
    objects: dict[str, Any] = field(default_factory=lambda: {name: Known(name) for name in "abcd"})
    entries = (
        SimpleNamespace(language="other", objects=("a",)),
        SimpleNamespace(language="task", objects="dc"),
    )
    perception = "demonstrations"


def test_a_first_look_is_timed_with_the_comparison_of_the_cameras_and_a_following_one_without():
    camera = Camera(64, 64, 60.0, 60.0, 31.5, 31.5, "world", np.eye(4))
    memory = Memory(dict.fromkeys(("front", "side", "back"), camera))
    policy: Any = SimpleNamespace(
        require_memory=lambda: memory, config=SimpleNamespace(hand_radius_m=0.05), segmenter=None
    )
    noise = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0))
    hand = Hand(np.eye(4), 0.04)
    observation = Observation("task", np.zeros(8), hand, {"front": noise, "side": noise}, None)
    told = look_ms(policy, [observation], 3)
    assert {key: told[key] for key in ("views", "objects", "found")} == {"views": 2, "objects": 3, "found": 3}
    assert told["first_ms"]["median"] >= 0
    sought = {name: known.sought for name, known in memory.objects.items()}
    assert sought["b"] == []
    assert sought["d"] == sought["c"] == sought["a"]
    # Both views together, then each by itself; and what is followed only together.
    looks = len(sought["d"])
    firsts = sought["d"].count((2, False))
    assert sought["d"][:3] == [(2, False), (1, True), (1, True)]
    assert looks - 3 * firsts == sought["d"].count((2, True)) == firsts - 1


def test_what_is_followed_is_timed_after_all_other_looks():
    camera = Camera(64, 64, 60.0, 60.0, 31.5, 31.5, "world", np.eye(4))
    memory = Memory(dict.fromkeys(("front", "side"), camera))
    policy: Any = SimpleNamespace(
        require_memory=lambda: memory, config=SimpleNamespace(hand_radius_m=0.05), segmenter=None
    )
    noise = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    first, last = (
        Observation("task", np.zeros(8), Hand(np.eye(4), 0.04), {"front": one}, None) for one in noise
    )
    counts = []
    for observations in ([first], [first, last], [first, last, first]):
        memory.objects["d"].sought.clear()
        look_ms(policy, observations, 3)
        counts.append(memory.objects["d"].sought.count((1, True)))
    assert np.diff(counts).tolist() == [1, 1]


@pytest.mark.slow
def test_perception_is_measured(
    checkpoint: Path, tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    monkeypatch.setattr(results, "is_published", lambda *_: True)
    config = PerceptionConfig(episodes=1, seed=2_000_000, workers=1, output=str(tmp_path / "out"))
    config.policy.path, config.dataset.root = str(checkpoint), str(tiny_dataset)
    config.env.task = "turn_on_stove"
    result = main(config)
    assert 0 < result["position_mm_mean"] <= result["position_mm_p95"] < 30
    assert 0 <= result["orientation_deg_mean"] < 10
    assert 0 < result["filter_us"] < 5000
    assert 0 < result["ms_per_observation"] < 5000
    assert result["n"] == result["variants"]["filtered"]["poses"] > 20
    assert list(result["objects"]) == ["stove"]
    assert (tmp_path / "perception_tabletop.json").is_file()
    config.dataset.root = str(tmp_path / "nothing")
    with pytest.raises(DatasetError, match=r"no dataset in .*nothing"):
        main(config)
