import json
from pathlib import Path

import pytest
from benchmarks.libero import experts
from benchmarks.libero.experts import ExpertsConfig

from lerobot_openspm.envs.collection import SUMMARY_FILE


def test_scenes_that_the_expert_did_not_solve_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def dataset(_: str, __: int, selection: str) -> Path:
        def of(success: bool, steps: int) -> list[dict]:
            return [{"task": one, "success": success, "steps": steps} for one in selection.split(",")]

        summary = tmp_path / selection / SUMMARY_FILE
        summary.parent.mkdir(parents=True)
        kept, failed = [*of(True, 90), *of(True, 110)], of(False, 300)
        summary.write_text(
            json.dumps({"settings": {"seed": 5}, "episodes": [*kept, *kept[:1]], "discarded": failed})
        )
        return summary.parents[1]

    monkeypatch.setattr(experts, "OBJECTS", ("one", "other"))
    monkeypatch.setattr(experts, "tasks", lambda suite: {f"{suite}_{i}": "" for i in range(3)})
    monkeypatch.setattr(experts, "scene_kind", lambda task: "kitchen" if task == "other_2" else "study")
    monkeypatch.setattr(experts, "dataset", dataset)
    monkeypatch.setattr(experts, "write", lambda _, told: told)
    told = experts.main(ExpertsConfig())
    folders = sorted(path.name for path in tmp_path.iterdir())
    assert folders == ["one_0,one_1,one_2", "other_0,other_1", "other_2"]
    assert list(told["per_task"]) == [f"{suite}_{i}" for suite in ("one", "other") for i in range(3)]
    assert (told["n"], told["success"], told["seed"]) == (6 * 3 + 3, 15 / 21, 5)
    first, last = told["per_task"]["one_0"], told["per_task"]["other_1"]
    assert (first["n"], first["success"], first["mean_steps"]) == (4, 3 / 4, pytest.approx(290 / 3, abs=0.05))
    assert (last["n"], last["success"], last["mean_steps"]) == (3, 2 / 3, 100)
