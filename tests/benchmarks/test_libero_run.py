"""`make libero`: which tasks are learned together, what that takes, and what is asked for wrongly."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from benchmarks.libero import evaluate, few_shot, new_task, run
from benchmarks.libero.equality import EqualityConfig
from benchmarks.libero.evaluate import EvaluationConfig
from benchmarks.libero.few_shot import FewShotConfig
from benchmarks.libero.new_task import NewTaskConfig
from benchmarks.libero.run import ALL, Part, RunConfig, learning, scene, size
from benchmarks.libero_pro import ProConfig
from tests.memory.memories import a_memory

from benchmarks import stages
from lerobot_openspm.cli.pipeline import DONE
from lerobot_openspm.envs.libero.simulator import OBJECTS
from lerobot_openspm.memory.io import write_memory


@pytest.fixture(autouse=True)
def ten_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten tasks in every suite, whether LIBERO is installed or not."""
    monkeypatch.setattr(run, "tasks", lambda suite: {f"{suite}_{i}": "" for i in range(10)})


def test_all_suites_are_selected_at_once():
    selected = RunConfig(suite=ALL, tasks="0,2-3").selected()
    assert list(selected) == list(OBJECTS)
    assert all(names == [f"{suite}_{i}" for i in (0, 2, 3)] for suite, names in selected.items())


def test_the_tasks_of_a_scene_are_learned_together():
    assert scene("KITCHEN_SCENE4_put_the_black_bowl_in_the_drawer") == "KITCHEN_SCENE4"
    assert scene("LIVING_ROOM_SCENE10_put_the_mug_on_the_plate") == "LIVING_ROOM_SCENE10"
    assert scene("put_the_bowl_on_the_plate") == ""


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"suite": "libero_90"}, "expected one of libero_goal.*all"),
        ({"tasks": "0-10"}, "from 0 to 9"),
        ({"states": 51}, "STATES must be 1 to 50"),
        ({"demos": 0}, "DEMOS at least 1"),
    ],
)
def test_what_is_asked_for_wrongly_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        RunConfig(**options)


@pytest.mark.parametrize(
    ("config", "options", "words"),
    [
        (FewShotConfig, {"demos": 0}, "demos must be 1 to 10 and states 1 to 50, got 0, 50"),
        (FewShotConfig, {"demos": 11}, "got 11, 50"),
        (FewShotConfig, {"states": 51}, "got 3, 51"),
        (EqualityConfig, {"states": 0}, "states must be 1 to 50, got 0"),
        (NewTaskConfig, {"task": "dance"}, "task is 'dance', expected one of libero_goal_0, libero_goal_1"),
        (NewTaskConfig, {"task": "libero_goal_0", "demos": 0}, "got 0, 50"),
        (
            EvaluationConfig,
            {"task": "dance"},
            r"libero_goal has no tasks \['dance'\], expected some of",
        ),
        (EvaluationConfig, {"episodes": 51}, "episodes must be 1 to 50, with tuning more, got 51"),
        (ProConfig, {"task": "dance"}, r"libero_goal_swap has no tasks \['dance'\]"),
    ],
)
def test_what_cannot_be_evaluated_is_refused_before_anything_is_learned(config, options, words, monkeypatch):
    for module in (new_task, evaluate):
        monkeypatch.setattr(module, "tasks", lambda suite: {f"{suite}_{i}": "" for i in range(10)})
    paths = {"checkpoint": "c", "output": "o"} if config is EvaluationConfig else {}
    with pytest.raises(ValueError, match=words):
        config(**paths, **options)


def test_a_checkpoint_holds_what_all_its_workplaces_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    memory, places = a_memory(), [tmp_path, tmp_path / "workplaces/1"]
    monkeypatch.setattr(run, "folders", lambda _: places)
    for place in places:
        write_memory(memory, place)
    (tmp_path / "model.safetensors").write_bytes(bytes(5_000_000))
    told = size(tmp_path)
    assert (told["entries"], told["objects"]) == (2 * len(memory.entries), 2 * len(memory.objects))
    held = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    assert told["checkpoint_mb"] == pytest.approx(held / 1e6, abs=0.01)
    assert told["checkpoint_mb"] > 5


def test_what_learning_took_is_not_known_where_a_part_was_interrupted(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(run, "size", lambda _: {})
    whole = Part("libero_10", ["a"], Path(), Path(), 60.0, 700)
    torn = Part("libero_10", ["b"], Path(), Path(), None, None)
    assert learning(Path(), [whole, whole]) == {"mine_and_train_s": 120.0, "peak_mb": 700}
    assert learning(Path(), [whole, torn]) == {"mine_and_train_s": None, "peak_mb": None}


def test_the_memory_of_a_training_is_noted_when_it_was_run_and_kept_with_it(tmp_path: Path, monkeypatch):
    took: list[float | None] = [12.0]

    def train(_: Path, output: Path, *__: Any) -> tuple[Path, float | None]:
        if not (output / DONE).exists():
            output.mkdir()
            (output / DONE).write_text("{}")
        return output / "checkpoints/last/pretrained_model", took[0]

    peaks = iter(({1: 400_000_000, 2: 512_000_000}, {}, {1: 900_000_000}))
    monkeypatch.setattr(stages, "train", train)
    monkeypatch.setattr(stages, "watched_memory", lambda: nullcontext(next(peaks)))
    for _ in range(2):
        checkpoint, _ = stages.policy(stages.TABLETOP, root=tmp_path / "dataset")
        assert stages.peak_mb(checkpoint) == 512
    took[0] = None  # of a training that was resumed the rest tells nothing
    checkpoint, _ = stages.policy(stages.TABLETOP, "resumed", root=tmp_path / "dataset")
    assert stages.peak_mb(checkpoint) is None


@pytest.mark.parametrize(
    ("suite", "name"),
    [("libero_goal", "libero_few_shot_3"), ("libero_spatial", "libero_spatial_few_shot_3")],
)
def test_of_each_suite_success_with_few_demonstrations_is_written_down(suite: str, name: str, monkeypatch):
    asked, written = list[Any](), dict[str, Any]()
    monkeypatch.setattr(few_shot, "find_suite", lambda *_: SimpleNamespace(tasks=lambda _: ["a", "b"]))
    monkeypatch.setattr(few_shot, "run_folder", lambda *_: Path("of_suite"))
    monkeypatch.setattr(
        few_shot, "learned", lambda selected, first: asked.append((selected, first)) or (Path("few"), [])
    )
    monkeypatch.setattr(few_shot, "learning", lambda *_: {"peak_mb": 700})
    monkeypatch.setattr(
        few_shot, "evaluate_states", lambda *some, **named: asked.append((*some, named["suite"])) or []
    )
    monkeypatch.setattr(few_shot, "summary", lambda _: {"n": 20})
    monkeypatch.setattr(few_shot, "write", lambda name, content, _: written.update({name: content}))
    few_shot.main(FewShotConfig(suite, states=10))
    assert asked == [
        ({suite: ["a", "b"]}, 3),
        (Path("few"), Path("of_suite/few_3_evaluation"), 10, ["a", "b"], suite),
    ]
    assert list(written) == [name]
    told = {"suite": suite, "demonstrations": 3, "peak_mb": 700, "n": 20}
    assert written[name].items() >= told.items()
