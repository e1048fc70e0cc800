"""`openspm memory`, typed as a user types it, on a memory made by hand."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.conftest import Openspm
from tests.memory.builders import entry, robot
from tests.memory.memories import LAYOUTS, a_memory, merged_entry, same
from tests.perception.builders import model, patch_model

from lerobot_openspm.cli.memory import COMMANDS
from lerobot_openspm.geometry.camera import cameras_to_dict
from lerobot_openspm.memory import io as module
from lerobot_openspm.memory.entry import Anchor, Outcome
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.stored_entries import StoredEntries

BOWL, DRAWER, STOVE = "put the bowl on the plate", "open the top drawer", "put the bowl on the stove"
OBJECTS = {"bowl": model("bowl", 1), "plate": model("plate", 2), "cabinet": model("cabinet", 3)}


def made() -> Memory:
    base = a_memory(objects=OBJECTS, layouts=LAYOUTS)
    return replace(base, entries=(*base.entries, entry(BOWL, source="local/demos#2", quality=0.6)))


@pytest.fixture(params=["read at load", "read when asked for"])
def memory(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A memory that is read as a small or as a large one is."""
    if request.param == "read when asked for":
        monkeypatch.setattr(module, "READ_AT_LOAD", 0)
    write_memory(made(), tmp_path / "memory")
    return tmp_path / "memory"


def load(memory: Path) -> Memory:
    """A memory with every entry read."""
    loaded = read_memory(memory)
    assert isinstance(loaded.entries, StoredEntries) == (module.READ_AT_LOAD == 0)
    return replace(loaded, entries=tuple(loaded.entries), superseded=tuple(loaded.superseded))


def run(openspm: Openspm, memory: Path, command: str, *options: str) -> dict[str, Any]:
    code, out, err = openspm("memory", command, f"--path={memory}", *options)
    assert code == 0, err
    return json.loads(out.splitlines()[-1])


def refused(openspm: Openspm, memory: Path, command: str, *options: str) -> str:
    """The one line that a mistake is answered with; the memory is as it was."""
    before = {path.name: path.read_bytes() for path in memory.iterdir()}
    code, out, err = openspm("memory", command, f"--path={memory}", *options)
    assert (code, out) == (2, "")
    assert {path.name: path.read_bytes() for path in memory.iterdir() if path.name != ".memory.lock"} == {
        name: content for name, content in before.items() if name != ".memory.lock"
    }
    assert "Traceback" not in err
    return err.splitlines()[-1]


def sources(memory: Path) -> list[str]:
    return [e.source for e in load(memory).entries]


def test_it_lists_its_commands_and_their_options(openspm: Openspm):
    code, out, _ = openspm("memory")
    assert code == 0
    assert all(f"  {name}" in out for name in COMMANDS)
    for name in COMMANDS:
        code, out, _ = openspm("memory", name, "--help")
        assert (code, "--path" in out) == (0, True)
    code, _, err = openspm("memory", "forget")
    assert (code, "unknown command 'forget'; expected one of list, show" in err) == (2, True)


def test_list(openspm: Openspm, memory: Path):
    code, out, _ = openspm("memory", "list", f"--path={memory}")
    assert code == 0
    assert [line.split("  ")[-2] for line in out.splitlines()[:-1]] == [f"local/demos#{i}" for i in range(3)]
    summary = {"entries": 3, "superseded": 0, "listed": 3, "per_task": {BOWL: 2, DRAWER: 1}}
    assert json.loads(out.splitlines()[-1]) == summary
    code, out, _ = openspm("memory", "list", f"--path={memory}", "--tasks=true", "--instruction=bowl")
    assert out.splitlines()[0].split() == ["2", "entries", "mean", "quality", "0.75", *repr(BOWL).split()]
    assert len(out.splitlines()) == 2
    assert "limit is -1, expected" in refused(openspm, memory, "list", "--limit=-1")
    _, out, _ = openspm("memory", "list", f"--path={memory}", "--limit=1")
    assert "... 2 more; --limit=3 lists all" in out
    assert json.loads(out.splitlines()[-1])["listed"] == 1


def test_show(openspm: Openspm, memory: Path):
    outcome = Outcome(0, "bowl", Anchor("plate", "plate"), np.array([0.0, 0.0, 0.01]), np.zeros(3), 0.02)
    shown = merged_entry(source="local/demos#0, local/demos#1", outcomes=(outcome,))
    write_memory(replace(made(), entries=(shown,)), memory)
    code, out, _ = openspm("memory", "show", f"--path={memory}", "--source=local/demos#0, local/demos#1")
    assert code == 0
    assert out.count(" mm, ") == len(merged_entry().key_poses) == out.count("  spread ")
    assert "done when the bowl is within 20.0 mm of 0.0 0.0 10.0 mm from the plate (axes of the plate)" in out
    told = json.loads(out.splitlines()[-1])
    assert told.pop("objects") == dict.fromkeys(OBJECTS, "shape")
    assert told == {"entries": 1, "shown": 1, "per_task": {shown.language: 1}}
    assert "holds nothing from 'elsewhere#1'" in refused(openspm, memory, "show", "--source=elsewhere#1")


def test_show_says_where_an_object_is_found(openspm: Openspm, memory: Path):
    write_memory(replace(made(), objects={**OBJECTS, "stove": patch_model("stove")}), memory)
    _, out, _ = openspm("memory", "show", f"--path={memory}", "--limit=1")
    assert "... 2 more; --limit=3 shows all" in out
    where = {
        line.split("'")[1]: line.partition(": found ")[2] for line in out.splitlines() if "known by" in line
    }
    assert where == {
        **dict.fromkeys(OBJECTS, "anywhere at the height where it stood in the demonstrations"),
        "stove": "only within 3.5 cm of where it stood in the demonstrations",
    }
    assert json.loads(out.splitlines()[-1])["objects"]["stove"] == "patches"


def test_what_is_removed_is_named_and_kept_as_superseded(openspm: Openspm, memory: Path):
    code, out, _ = openspm("memory", "remove", f"--path={memory}", "--source=local/demos#2")
    assert code == 0
    assert out.splitlines()[0] == f"removed version 1 of local/demos#2: {BOWL!r}"
    assert json.loads(out.splitlines()[-1]) == {"entries": 2, "superseded": 1, "removed": 1}
    loaded = load(memory)
    assert same(loaded, replace(made(), entries=made().entries[:2], superseded=made().entries[2:]))
    _, out, _ = openspm("memory", "list", f"--path={memory}", "--all=true")
    assert [line.endswith("superseded") for line in out.splitlines()[:-1]] == [False, False, True]


def test_removing_nothing_or_everything_is_refused(openspm: Openspm, memory: Path):
    assert "pass --source=DATASET#EPISODE or --instruction" in refused(openspm, memory, "remove")
    error = refused(openspm, memory, "remove", "--instruction=put the bowl")
    assert f"holds no entry of 'put the bowl'; it knows: {DRAWER}; {BOWL}" in error
    assert run(openspm, memory, "remove", f"--instruction={BOWL}")["removed"] == 2
    error = refused(openspm, memory, "remove", f"--instruction={DRAWER}")
    assert "would remove all 1 entries" in error


def test_add_takes_entries_and_objects_of_another_memory_once(openspm: Openspm, memory: Path, tmp_path: Path):
    objects = {**OBJECTS, "stove": model("stove", 4)}
    other = replace(made(), objects=objects, entries=(made().entries[0], entry(STOVE, source="local/new#0")))
    write_memory(other, tmp_path / "other")
    added = run(openspm, memory, "add", f"--other={tmp_path / 'other'}")
    assert added == {"entries": 4, "superseded": 0, "added": 1, "unchanged": 1}
    assert sources(memory) == [*(f"local/demos#{i}" for i in range(3)), "local/new#0"]
    assert set(load(memory).objects) == {"stove", "bowl", "plate", "cabinet"}
    again = run(openspm, memory, "add", f"--other={tmp_path / 'other'}")
    assert again == {"entries": 4, "superseded": 0, "added": 0, "unchanged": 2}


ELSEWHERE = {
    "perception": ({"perception": "oracle"}, "perception is 'oracle', the memory's 'demonstrations'"),
    "segmentation": ({"segmentation": "sam3"}, "segmentation is 'sam3'"),
    "shape": ({"shape": "box"}, "shape is 'box'"),
    "layout": ({"layouts": LAYOUTS[::-1]}, "'layouts': the memory's state is"),
    "gripper": ({"robot": robot(close_command=-1.0, open_command=1.0)}, "close_command is -1"),
    "objects": ({"objects": {**OBJECTS, "plate": model("plate", 9)}}, "'plate' is known by another model"),
}


@pytest.mark.parametrize("what", ELSEWHERE)
def test_entries_from_elsewhere_are_refused(openspm: Openspm, memory: Path, tmp_path: Path, what: str):
    changes, message = ELSEWHERE[what]
    write_memory(replace(made(), **changes), tmp_path / "other")
    assert message in refused(openspm, memory, "add", f"--other={tmp_path / 'other'}") or what == "gripper"
    if what == "gripper":
        new = replace(made(), entries=(entry(BOWL, source="local/new#0"),), **changes)
        write_memory(new, tmp_path / "other")
        assert message in refused(openspm, memory, "add", f"--other={tmp_path / 'other'}")


def test_add_refuses_what_is_no_memory(openspm: Openspm, memory: Path, tmp_path: Path):
    assert "pass --other=FOLDER" in refused(openspm, memory, "add")
    assert "nothing at nowhere" in refused(openspm, memory, "add", "--other=nowhere")
    (tmp_path / "some.json").write_text('{"format": "zip"}')
    assert "expected 'openspm-entries' and 10" in refused(
        openspm, memory, "add", f"--other={tmp_path / 'some.json'}"
    )
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no memory at" in refused(openspm, empty, "add", f"--other={memory}")


def test_an_exported_file_can_be_edited_and_added_again(openspm: Openspm, memory: Path, tmp_path: Path):
    file = tmp_path / "entries.json"
    assert run(openspm, memory, "export", f"--output={file}", f"--instruction={BOWL}")["entries"] == 2
    assert run(openspm, memory, "add", f"--other={file}")["unchanged"] == 2
    assert same(load(memory), made())
    exported = json.loads(file.read_text())
    assert sorted(exported["objects"]) == ["bowl", "plate"]
    exported["entries"][1]["key_poses"][0]["T_obj_ee"][2][3] = 0.5
    file.write_text(json.dumps(exported))
    added = run(openspm, memory, "add", f"--other={file}")
    assert added == {"entries": 3, "superseded": 1, "added": 1, "unchanged": 1}
    after = load(memory)
    assert sorted(sources(memory)) == [f"local/demos#{i}" for i in range(3)]
    edited = next(e for e in after.entries if e.source == "local/demos#2")
    assert (edited.version, edited.key_poses[0].T_obj_ee[2, 3]) == (2, 0.5)
    assert same(after.superseded[0], made().entries[2])


def edit(file: Path, change: Any) -> None:
    exported = json.loads(file.read_text())
    change(exported["entries"])
    file.write_text(json.dumps(exported))


def test_a_file_with_two_entries_of_one_source_and_instruction_is_refused(
    openspm: Openspm, memory: Path, tmp_path: Path
):
    file = tmp_path / "entries.json"
    run(openspm, memory, "export", f"--output={file}")
    edit(file, lambda rows: rows.extend([{**rows[0], "quality": 0.1}, {**rows[0], "quality": 0.2}]))
    error = refused(openspm, memory, "add", f"--other={file}")
    assert f"entries[0] and entries[3] are both of source 'local/demos#0' and instruction {BOWL!r}" in error
    # Of one source there may well be several instructions.
    edit(file, lambda rows: [rows.pop(), rows[3].update(language=f"{BOWL} now")])
    assert run(openspm, memory, "add", f"--other={file}")["added"] == 1
    assert len(load(memory).entries) == 4


def test_what_was_merged_or_removed_is_not_added_again(openspm: Openspm, memory: Path, tmp_path: Path):
    other, file, merged = tmp_path / "other", tmp_path / "entries.json", tmp_path / "merged"
    run(openspm, memory, "rate", "--source=local/demos#0", "--success=true")
    write_memory(made(), other)  # its entries have no outcomes, so are not quite what was merged
    run(openspm, memory, "export", f"--output={file}")
    run(openspm, memory, "merge")
    for source in (other, file):
        again = run(openspm, memory, "add", f"--other={source}")
        assert again == {"entries": 2, "superseded": 2, "added": 0, "unchanged": 3}
    # Also where nothing is known of how the merged entry came about.
    run(openspm, memory, "export", f"--output={merged}")
    assert run(openspm, merged, "add", f"--other={other}")["added"] == 0
    edit(file, lambda rows: rows[2].update(quality=0.1))
    error = refused(openspm, memory, "add", f"--other={file}")
    assert "entries[2] is an edited 'local/demos#2', which is part of the merged entry" in error
    run(openspm, memory, "remove", "--source=local/demos#1")
    assert run(openspm, memory, "add", f"--other={other}")["added"] == 0
    assert run(openspm, memory, "restore", "--source=local/demos#1")["entries"] == 2


def test_a_file_can_bring_back_what_an_entry_was(openspm: Openspm, memory: Path, tmp_path: Path):
    before, edited = tmp_path / "before.json", tmp_path / "edited.json"
    for file in (before, edited):
        run(openspm, memory, "export", f"--output={file}")
    edit(edited, lambda rows: rows[1].update(quality=0.1))
    assert run(openspm, memory, "add", f"--other={edited}")["added"] == 1
    assert run(openspm, memory, "add", f"--other={before}")["added"] == 1
    assert [(e.version, e.quality) for e in load(memory).entries if e.source[-1] == "1"] == [(3, 0.9)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda e: e["entries"][0].update(quality=3),
            "entries[0]: malformed: Expected `float` <= 1.0 - at `$.quality`",
        ),
        (
            lambda e: e["entries"][1]["key_poses"][0].pop("T_obj_ee"),
            "entries[1]: malformed: Object missing required field `T_obj_ee` - at `$.key_poses[0]`",
        ),
        (lambda e: e["objects"].update(bowl="0" * 16), "'bowl' is known by another model"),
        (lambda e: e.update(entries=3), "Expected `array`, got `int` - at `$.entries`"),
        (lambda e: e.update(colour="red"), "unknown field `colour`"),
        (lambda e: e["robot"].pop("open_width"), "field `open_width` - at `$.robot`"),
        (
            lambda e: e.update(version=99),
            "got format and version ['openspm-entries', 99], expected 'openspm-entries' and 10",
        ),
    ],
)
def test_a_badly_edited_file_is_refused(
    openspm: Openspm, memory: Path, tmp_path: Path, change: Any, message: str
):
    file = tmp_path / "entries.json"
    run(openspm, memory, "export", f"--output={file}")
    exported = json.loads(file.read_text())
    change(exported)
    file.write_text(json.dumps(exported))
    error = refused(openspm, memory, "add", f"--other={file}")
    assert str(file) in error
    assert message in error


def test_an_exported_folder_is_a_memory(openspm: Openspm, memory: Path, tmp_path: Path):
    run(openspm, memory, "export", f"--output={tmp_path / 'out'}", "--source=local/demos#1")
    assert same(load(tmp_path / "out"), replace(made(), entries=made().entries[1:2]))
    assert "exists already" in refused(openspm, memory, "export", f"--output={tmp_path / 'out'}")
    error = refused(openspm, memory, "export", f"--output={tmp_path / 'more'}", "--source=elsewhere#1")
    assert "holds no such entry" in error


def test_what_was_removed_or_edited_is_restored(openspm: Openspm, memory: Path):
    edited = replace(entry(BOWL, source="local/demos#2", quality=0.1), version=2)
    write_memory(
        replace(made(), entries=(*made().entries[:2], edited), superseded=made().entries[2:]), memory
    )
    restored = run(openspm, memory, "restore", "--source=local/demos#2")
    assert restored == {"entries": 3, "superseded": 1, "restored": "local/demos#2", "version": 3}
    after = load(memory)
    assert same(after.entries[-1], replace(made().entries[2], version=3))
    assert same(after.superseded[0], edited)
    run(openspm, memory, "remove", "--source=local/demos#2")
    error = refused(openspm, memory, "restore", "--source=local/demos#2", "--version=1")
    assert "no such superseded entry of 'local/demos#2', of its versions: 2, 3" in error
    assert run(openspm, memory, "restore", "--source=local/demos#2", "--version=2")["version"] == 4
    assert load(memory).entries[-1].quality == 0.1
    assert [(e.source, e.version) for e in load(memory).superseded] == [("local/demos#2", 3)]


def test_of_entries_of_one_source_one_is_restored_by_its_instruction(openspm: Openspm, memory: Path):
    other = entry(STOVE, source="local/demos#2")
    write_memory(replace(made(), entries=made().entries[:2], superseded=(made().entries[2], other)), memory)
    which = ("restore", "--source=local/demos#2")
    error = refused(openspm, memory, *which)
    assert (
        f"2 entries come from 'local/demos#2'; pass --instruction=TEXT with one of: {BOWL}; {STOVE}" in error
    )
    error = refused(openspm, memory, *which, "--instruction=sing")
    assert "no such superseded entry of 'local/demos#2' and 'sing', of its versions: none" in error
    run(openspm, memory, *which, f"--instruction={BOWL}")
    assert [e.language for e in load(memory).superseded] == [STOVE]
    run(openspm, memory, *which)
    assert load(memory).entries[-1].language == STOVE


def test_merge(openspm: Openspm, memory: Path):
    assert run(openspm, memory, "merge") == {"entries": 2, "superseded": 2, "merged": 2, "into": 1}
    assert sources(memory) == ["local/demos#0, local/demos#2", "local/demos#1"]
    assert load(memory).entries[0].quality == pytest.approx(0.75)
    assert run(openspm, memory, "merge")["merged"] == 0
    assert "distance_m is -1" in refused(openspm, memory, "merge", "--distance_m=-1")


def test_rate(openspm: Openspm, memory: Path):
    rated = run(openspm, memory, "rate", "--source=local/demos#2", "--success=true")
    assert rated == {
        "entries": 3, "superseded": 0, "quality": pytest.approx(4 / 6), "trials": 1, "successes": 1,
    }  # fmt: skip
    assert run(openspm, memory, "rate", "--source=local/demos#2", "--success=false")["trials"] == 2
    assert [e.trials for e in load(memory).entries] == [0, 0, 2]
    assert "pass --success=true or" in refused(openspm, memory, "rate", "--source=local/demos#2")
    same_source = entry(STOVE, source="local/demos#2")
    write_memory(replace(made(), entries=(*made().entries, same_source)), memory)
    error = refused(openspm, memory, "rate", "--source=local/demos#2", "--success=true")
    assert (
        f"2 entries come from 'local/demos#2'; pass --instruction=TEXT with one of: {BOWL}; {STOVE}" in error
    )


def test_of_entries_of_one_source_and_instruction_one_is_rated_by_its_number(openspm: Openspm, memory: Path):
    twin = entry(BOWL, source="local/demos#2", quality=0.3)
    write_memory(replace(made(), entries=(*made().entries, twin)), memory)
    which = ("rate", "--source=local/demos#2", f"--instruction={BOWL}", "--success=true")
    error = refused(openspm, memory, *which)
    assert "2 entries come from 'local/demos#2'; pass --entry=NUMBER with one of: 2 (" in error
    assert f"; 3 ({BOWL!r}, version 1, 8 key poses, quality 0.30, succeeded 0 of 0)" in error
    assert run(openspm, memory, *which, "--entry=3")["trials"] == 1
    assert [e.trials for e in read_memory(memory).entries] == [0, 0, 0, 1]
    assert "entry 0 is none of those that come from" in refused(openspm, memory, *which, "--entry=0")


def test_another_calibration_is_put_into_a_memory(openspm: Openspm, memory: Path, tmp_path: Path):
    file = tmp_path / "cameras.json"
    cameras = {key: replace(camera, fx=60.5) for key, camera in made().cameras.items()}
    file.write_text(json.dumps(cameras_to_dict(cameras)))
    assert run(openspm, memory, "cameras", f"--file={file}")["cameras"] == ["observation.images.front"]
    assert load(memory).cameras["observation.images.front"].fx == 60.5
    file.write_text(file.read_text().replace("60.5", "-0.0"))
    assert "focal lengths must be positive" in refused(openspm, memory, "cameras", f"--file={file}")
