import json
import re

import numpy as np
import pytest
from tests.memory.builders import entry, robot
from tests.memory.memories import LAYOUTS, a_memory, merged_entry, same
from tests.memory.memory_files import (
    edit_arrays,
    edit_entries,
    edit_header,
    name_of,
    names,
    vouch_for,
    write_texts,
)
from tests.memory.old_format import save_version_4
from tests.perception.builders import model

from lerobot_openspm.errors import CalibrationError, MemoryFormatError, OpenSPMError
from lerobot_openspm.memory.memory import VERSION, read_memory, write_memory


@pytest.fixture
def saved(tmp_path):
    write_memory(a_memory(), tmp_path)
    return tmp_path


def test_what_is_saved_is_loaded_to_the_last_bit(saved):
    assert same(read_memory(saved), a_memory())
    assert sorted(path.name for path in saved.iterdir()) == sorted(names(saved))


def test_what_is_merged_superseded_and_known_of_the_robot_is_loaded_to_the_last_bit(tmp_path):
    whole = a_memory(
        entries=(merged_entry(), entry(trials=7, successes=3, quality=0.5)),
        superseded=(entry(source="local/demos#7"),),
        layouts=LAYOUTS,
    )
    write_memory(whole, tmp_path)
    assert same(read_memory(tmp_path), whole)


def test_an_experience_without_entries_or_objects_survives_too(tmp_path):
    empty = a_memory(entries=(), objects={}, simulator_objects=())
    write_memory(empty, tmp_path / "new" / "folder")
    assert same(read_memory(tmp_path / "new" / "folder"), empty)


def test_equal_experiences_make_equal_files(saved, tmp_path):
    write_memory(read_memory(saved), tmp_path / "again")
    assert names(tmp_path / "again") == names(saved)
    for name in names(saved):
        assert (tmp_path / "again" / name).read_bytes() == (saved / name).read_bytes()


def test_entries_are_a_json_list_with_one_on_every_line(saved):
    text = (saved / name_of(saved, "entries")).read_text()
    rows = json.loads(text)
    assert [row["source"] for row in rows] == ["local/demos#0", "local/demos#1"]
    assert [json.loads(line.rstrip(",")) for line in text.splitlines()[1:-1]] == rows


def test_yaw_periods_are_those_of_the_objects():
    assert a_memory().yaw_periods == {
        "bowl": 2 * np.pi,
        "cream cheese box": np.pi,
        "stove": 2 * np.pi,
        "rack": np.pi,
        "mug": 2 * np.pi,
    }


def test_what_found_the_objects_is_remembered(tmp_path):
    made = a_memory(segmentation="given", shape="box")
    write_memory(made, tmp_path)
    assert same(read_memory(tmp_path), made)


def test_a_memory_of_version_4_is_read_and_saved_as_the_newest(tmp_path):
    save_version_4(a_memory(), tmp_path)
    loaded = read_memory(tmp_path)
    assert same(loaded, a_memory())
    write_memory(loaded, tmp_path)
    assert same(read_memory(tmp_path), a_memory())
    assert sorted(path.name for path in tmp_path.iterdir() if path.name[0] != ".") == sorted(names(tmp_path))


@pytest.mark.parametrize("version", [1, 2, 3])
def test_memories_from_before_segmenters_are_read(tmp_path, version):
    older = a_memory(objects={"bowl": model("bowl", 1), "stove": model("stove", 2)})
    save_version_4(older, tmp_path)
    path = tmp_path / "memory.json"
    memory = json.loads(path.read_text())
    memory["version"] = version
    del memory["segmentation"], memory["shape"]
    for fields in memory["objects"]:
        del fields["foreground"]
    path.write_text(json.dumps(memory))
    loaded = read_memory(tmp_path)
    assert same(loaded, older)
    assert (loaded.segmentation, loaded.shape) == ("demonstrations", "demonstrations")


@pytest.mark.parametrize("index", range(4))
def test_a_missing_file_is_named(saved, index):
    name = names(saved)[index]
    (saved / name).unlink()
    with pytest.raises(OpenSPMError, match=re.escape(str(saved / name))):
        read_memory(saved)


def test_another_calibration_is_refused_until_somebody_means_it(saved, tmp_path):
    file = saved / "cameras.json"
    file.write_text(file.read_text().replace("50.1", "50.3"))
    with pytest.raises(CalibrationError, match=r"cameras\.json: its checksum.*--policy\.cameras="):
        read_memory(saved)
    meant = read_memory(saved, cameras=file)
    assert meant.cameras["observation.images.front"].fx == 50.3
    write_memory(meant, saved)
    assert same(read_memory(saved), meant)


def setting(*path, value):
    def change(memory):
        part = memory
        for key in path[:-1]:
            part = part[key]
        part[path[-1]] = value

    return change


def without(*path):
    def change(memory):
        part = memory
        for key in path[:-1]:
            part = part[key]
        del part[path[-1]]

    return change


ENTRY = (0,)
POSE = (*ENTRY, "key_poses", 0)
SUB_TASK = (*ENTRY, "key", "sub_tasks", 0)
AXIS = {"kind": "slide", "direction": [1.0, 0.0, 0.0], "amount": 0.1}
HEADERS = {
    "newer version": (setting("version", value=VERSION + 1), rf"version {VERSION + 1}.*upgrade"),
    "no version": (without("version"), "version None"),
    "version 0": (setting("version", value=0), "version 0"),
    "other format": (setting("format", value="zip"), "'zip'"),
    "no robot": (without("robot"), "robot"),
    "robot without gains": (without("robot", "metres_per_action"), "'robot'.*metres_per_action"),
    "robot NaN": (setting("robot", "open_width", value=float("nan")), "NaN is no JSON number"),
    "robot beyond floats": (setting("robot", "open_width", value=10**400), "'robot'"),
    "workspace of another shape": (setting("robot", "workspace", value=[[0, 0, 0]]), "'robot'"),
    "no perception": (without("perception"), "perception"),
    "no simulator objects": (without("simulator_objects"), "simulator_objects"),
    "unknown segmentation": (setting("segmentation", value="magic"), "segmentation is 'magic'.*sam3"),
    "unknown shape": (setting("shape", value=["box"]), r"shape is \['box'\], expected one of demonstr"),
    "a box of no size": (setting("objects", 3, "size", value=[0, 0, 0]), "'size'"),
    "a box without a side": (without("objects", 3, "size", 0), "'size'.*'rack'"),
    "a shape without its foreground": (without("objects", 4, "foreground"), "log_odds"),
    "objects of another kind": (setting("objects", value={}), "'objects'"),
    "an object of another kind": (setting("objects", 0, value=3), "'objects'"),
    "an object renamed": (setting("objects", 0, "name", value="cup"), "log_odds"),
    "an object without a name": (without("objects", 0, "name"), "name"),
    "an unknown field": (setting("colour", value="red"), "unknown fields.*colour"),
    "no files": (without("files"), "files"),
    "files of another kind": (setting("files", value=[]), r"'files' is \[\], expected an object"),
    "a file that nobody reads": (setting("files", "more", value={"file": "x"}), r"'files' has unknown.*more"),
    "open width below 0": (
        setting("robot", "open_width", value=-1),
        "'open_width' is -1, expected .* from 0",
    ),
    "a gain beyond robots": (setting("robot", "metres_per_action", value=1e300), "'metres_per_action' is 1e"),
    "a speed below 0": (setting("robot", "metres_per_step", value=-0.1), "'metres_per_step' is -0.1"),
    "workspace exchanged": (
        setting("robot", "workspace", value=[[0.5, 0.5, 0.5], [-0.5, 0.6, 0.6]]),
        "'workspace' is .*expected the lowest",
    ),
    "workspace beyond robots": (
        setting("robot", "workspace", value=[[0, 0, 0], [1e300, 1, 1]]),
        "'workspace' must hold 2 x 3 numbers",
    ),
    "an object twice": (
        lambda header: header["objects"].append(header["objects"][0]),
        "'objects' has 'bowl' twice",
    ),
    "no file of entries": (without("files", "entries"), r"files\['entries'\]"),
    "a file somewhere else": (setting("files", "arrays", "file", value="../a.safetensors"), "has the name"),
    "no checksum": (without("files", "arrays", "sha256"), "checksum"),
    "wrong checksum": (setting("files", "arrays", "sha256", value="0" * 64), "checksum"),
    "more entries than there are": (setting("n_entries", value=3), "'n_entries' is 3, .* holds 2"),
    "entries below 0": (setting("n_entries", value=-1), "n_entries"),
    "an anchor that is not listed": (setting("anchored", value=["bowl"]), r"entries\[0\].*'plate'"),
    "layouts of another kind": (setting("layouts", value=["state"]), "'layouts'"),
    "a layout without a gripper": (
        setting(
            "layouts",
            value={what: {"names": ["x", "y", "z"], "rotation": "none"} for what in ("state", "action")},
        ),
        "hold no gripper",
    ),
    "a layout of another rotation": (
        setting(
            "layouts",
            value={
                what: {"names": ["x", "y", "z", "gripper"], "rotation": "bent"}
                for what in ("state", "action")
            },
        ),
        "rotation is 'bent'",
    ),
}

ENTRIES = {
    "an entry of another kind": (setting(*ENTRY, value=7), r"entries\[0\]"),
    "an entry that is text": (setting(*ENTRY, value="bowl"), r"entries\[0\]"),
    "entry without language": (without(*ENTRY, "language"), r"entries\[0\].*language"),
    "quality beyond 1": (setting(*ENTRY, "quality", value=1.5), r"entries\[0\].*quality"),
    "quality NaN": (setting(*ENTRY, "quality", value=float("nan")), r"entries\[0\].*NaN"),
    "quality text": (setting(*ENTRY, "quality", value="good"), r"entries\[0\]"),
    "version beyond integers": (setting(*ENTRY, "version", value=float("inf")), r"entries\[0\]"),
    "key of another kind": (setting(*ENTRY, "key", value=None), r"entries\[0\]"),
    "no sub-task": (setting(*ENTRY, "key", "sub_tasks", value=[]), r"entries\[0\].*sub-task"),
    "sub-task that is text": (setting(*ENTRY, "key", "sub_tasks", value=["put"]), r"entries\[0\]"),
    "sub-task with another field": (
        setting(*ENTRY, "key", "sub_tasks", 0, "speed", value="1"),
        r"entries\[0\].*speed",
    ),
    "no key pose": (setting(*ENTRY, "key_poses", value=[]), r"entries\[0\]"),
    "key pose that is text": (setting(*POSE, value="grasp"), r"entries\[0\]"),
    "unknown phase": (setting(*POSE, "phase", value="dance"), r"entries\[0\].*'dance'"),
    "confidence below 0": (setting(*POSE, "confidence", value=-0.1), r"entries\[0\].*confidence"),
    "opening NaN": (setting(*POSE, "opening", value=float("nan")), r"entries\[0\].*NaN"),
    "opening infinite": (setting(*POSE, "opening", value=10**400), r"entries\[0\].*opening"),
    "closed as number": (setting(*POSE, "closed", value=1), r"entries\[0\].*'closed'"),
    "steps beyond integers": (setting(*POSE, "n_steps", value=float("inf")), r"entries\[0\]"),
    "anchor that is nowhere": (setting(*POSE, "anchor", "place", value="cup"), r"entries\[0\].*'cup'"),
    "anchor as text": (setting(*POSE, "anchor", value="bowl"), r"entries\[0\]"),
    "axis of no kind": (setting(*POSE, "axis", value=AXIS | {"kind": "bend"}), r"entries\[0\].*'bend'"),
    "axis of 2 numbers": (setting(*POSE, "axis", value=AXIS | {"direction": [1, 0]}), r"entries\[0\].*unit"),
    "axis too long": (setting(*POSE, "axis", value=AXIS | {"direction": [1, 1, 0]}), r"entries\[0\].*unit"),
    "axis NaN": (setting(*POSE, "axis", value=AXIS | {"amount": 10**400}), r"entries\[0\].*amount"),
    "axis without amount": (setting(*POSE, "axis", value={"kind": "turn"}), r"entries\[0\]"),
    "anchor without axes": (without(*POSE, "anchor", "axes"), r"entries\[0\].*axes"),
    "entry with another field": (setting(*ENTRY, "colour", value=1), r"entries\[0\].*colour"),
    "key pose with another field": (setting(*POSE, "speed", value=1), r"entries\[0\].*speed"),
    "version 0": (setting(*ENTRY, "version", value=0), r"entries\[0\].*version"),
    "version as fraction": (setting(*ENTRY, "version", value=1.5), r"entries\[0\].*version"),
    "language as number": (setting(*ENTRY, "language", value=3), r"entries\[0\].*language"),
    "more successes than trials": (setting(*ENTRY, "successes", value=1), r"entries\[0\].*successes"),
    "trials as truth": (setting(*ENTRY, "trials", value=True), r"entries\[0\].*trials"),
    "layout of another kind": (setting(*ENTRY, "layout", value=3), r"entries\[0\]"),
    "one object less": (without(*ENTRY, "layout", "bowl"), r"entries\[0\].*'bowl'"),
    "a sub-task there is not": (setting(*POSE, "sub_task", value=1), r"entries\[0\].*'sub_task' is 1"),
    "pose as text": (setting(*POSE, "T_obj_ee", value="here"), r"entries\[0\].*T_obj_ee"),
    "pose of texts": (setting(*POSE, "T_obj_ee", value=[["1"] * 4] * 3), r"entries\[0\].*T_obj_ee"),
    "ragged pose": (setting(*POSE, "T_obj_ee", value=[[1, 0], [0, 1, 0]]), r"entries\[0\].*T_obj_ee"),
    "pose of two rows": (without(*POSE, "T_obj_ee", 0), r"entries\[0\].*T_obj_ee"),
    "scaled pose": (setting(*POSE, "T_obj_ee", 0, 0, value=1.5), r"entries\[0\].*T_obj_ee.*rigid"),
    "huge pose": (setting(*POSE, "T_obj_ee", 0, 0, value=1e300), r"entries\[0\].*T_obj_ee.*numbers from"),
    "null in a pose": (setting(*POSE, "T_obj_ee", 0, 3, value=None), r"entries\[0\].*T_obj_ee"),
    "mirrored layout": (setting(*ENTRY, "layout", "bowl", 2, value=[0, 0, -1, 0]), r"entries\[0\].*'layout'"),
    "source with half a character": (
        setting(*ENTRY, "source", value="a\ud800"),
        r"'source' is 'a\\+ud800', expected text without",
    ),
    "source that a terminal obeys": (setting(*ENTRY, "source", value="a\x1b[2J"), r"without '\\+x1b'"),
    "source of two lines": (setting(*ENTRY, "source", value="a\nb"), r"'source'.* without '\\+n'"),
    "no source": (setting(*ENTRY, "source", value=""), r"'source' is '', expected text that is not empty"),
    "no language": (setting(*ENTRY, "language", value=" "), r"entries\[0\].*'language' is empty"),
    "language with half a character": (setting(*ENTRY, "language", value="put \udfff"), r"'language' is "),
    "layout with half a character": (
        lambda rows: rows[0]["layout"].update({"a\ud800": rows[0]["layout"]["bowl"]}),
        "a name in 'layout' is",
    ),
    "landmarks with half a character": (
        setting(*SUB_TASK, "target_where", value={"relation": "on", "landmarks": ["a\ud800"]}),
        "'landmarks'",
    ),
    "trials beyond counting": (setting(*ENTRY, "trials", value=10**400), r"'trials' is about 2\*\*1329"),
    "steps beyond counting": (setting(*POSE, "n_steps", value=10**400), r"'n_steps' is about 2\*\*1329"),
    "version beyond counting": (setting(*ENTRY, "version", value=10**10), r"'version' is 10000000000, exp"),
    "opening beyond grippers": (setting(*POSE, "opening", value=-1e308), r"'opening' is -1e\+308"),
    "place beyond tables": (setting(*POSE, "T_obj_ee", 0, 3, value=1e300), r"T_obj_ee.*numbers from -1e\+09"),
    "unknown operation": (
        setting(*SUB_TASK, "operation", value="explode"),
        "'operation' is 'explode', expected one of .*'put'",
    ),
    "unknown relation": (setting(*SUB_TASK, "relation", value="inside out"), "'relation' is 'inside out'"),
    "unknown reference": (
        setting(*SUB_TASK, "target_where", value={"relation": "near-ish", "landmarks": []}),
        "'relation' is 'near-ish', expected one of .*'left'",
    ),
    "covariance of 2 rows": (setting(*POSE, "covariance", value=[[1] * 6] * 2), r"entries\[0\].*covariance"),
    "covariance not symmetric": (
        setting(*POSE, "covariance", value=np.triu(np.ones((6, 6))).tolist()),
        r"covariance' is not symmetric",
    ),
    "covariance below 0": (setting(*POSE, "covariance", value=(-np.eye(6)).tolist()), r"semi-definite"),
}


def is_named(saved, words, file):
    with pytest.raises(MemoryFormatError, match=words) as caught:
        read_memory(saved)
    assert str(saved / file) in str(caught.value)


@pytest.mark.parametrize("name", HEADERS)
def test_a_spoilt_header_names_file_and_field_even_if_somebody_vouches_for_it(saved, name):
    change, words = HEADERS[name]
    edit_header(saved, change)
    is_named(saved, words, "memory")


@pytest.mark.parametrize("name", ENTRIES)
def test_a_spoilt_entry_names_file_and_field_even_if_somebody_vouches_for_it(saved, name):
    change, words = ENTRIES[name]
    edit_entries(saved, change)
    is_named(saved, words, name_of(saved, "entries"))


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        ([b"[" * 1_000_000 + b"]" * 1_000_000], "recursion|nest"),
        ([b'{"a":' * 500_000], "recursion|nest"),
        ([b'{"source": "a", "source": "b"}'], "key 'source' twice"),
        ([b'{"quality": NaN}'], "NaN is no JSON number"),
        ([b'{"quality": -Infinity}'], "-Infinity is no JSON number"),
        ([b"\xff\xfe"], "utf-8"),
        ([b"9" * 6000], "truncated, changed or not JSON"),
        ([b"7"], "expected an object"),
    ],
)
def test_a_line_that_is_no_entry_is_named(saved, texts, words):
    write_texts(saved, texts)
    edit_header(saved, lambda header: header.update(n_entries=len(texts)))
    is_named(saved, words, name_of(saved, "entries") + ": entries[0]")


def recast(array, convert):
    return lambda arrays: arrays.update({array: convert(arrays[array]).copy()})


def spoil(array, index, value):
    def change(arrays):
        spoilt = arrays[array].copy()
        spoilt[index] = value
        arrays[array] = spoilt

    return change


POINTS, LOG_ODDS = "objects.bowl.points", "objects.bowl.log_odds"
ENDS, DIGESTS = "entries.ends", "entries.digests"
ARRAYS = {
    "no ends": (lambda a: a.pop(ENDS), ENDS),
    "ends of floats": (recast(ENDS, lambda x: x.astype(np.float64)), ENDS),
    "ends that count down": (recast(ENDS, lambda x: x[::-1]), "count up"),
    "ends below 0": (spoil(ENDS, 0, -5), "count up"),
    "an end too early": (spoil(ENDS, 1, 1000), "count up|expected .* truncated or changed"),
    "an end beyond the file": (spoil(ENDS, 1, 10**6), "expected 100.* truncated or changed"),
    "an end beyond all memory": (spoil(ENDS, 1, 2**62), "count up"),
    "ends that overflow": (spoil(ENDS, 0, -(2**63)), "count up"),
    "a line moved": (spoil(ENDS, 0, 100), r"entries\[0\] is not what its digest says"),
    "no digests": (lambda a: a.pop(DIGESTS), DIGESTS),
    "one digest less": (recast(DIGESTS, lambda x: x[:-1]), DIGESTS),
    "wider digests": (recast(DIGESTS, lambda x: x.astype(np.uint16)), DIGESTS),
    "another digest": (spoil(DIGESTS, (1, 3), 7), r"entries\[1\] is not what its digest says"),
    "no points": (lambda a: a.pop(POINTS), "points"),
    "NaN points": (spoil(POINTS, (0, 0), np.nan), "points"),
    "double points": (recast(POINTS, lambda T: T.astype(np.float64)), "points"),
    "few colours": (recast(LOG_ODDS, lambda x: x[:5]), "log_odds"),
}  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_spoilt_arrays_are_named_even_if_somebody_vouches_for_them(saved, name):
    change, words = ARRAYS[name]
    edit_arrays(saved, change)
    is_named(saved, words, "memory")


def test_arrays_that_are_no_safetensors_are_named(saved):
    for blob in (b"", b"hello", b"\xff" * 64, (10**15).to_bytes(8, "little") + b"{}"):
        vouch_for(saved, blob)
        is_named(saved, "not safetensors", name_of(saved, "arrays"))


@pytest.mark.parametrize(
    "content",
    [b"[" * 1_000_000, b'{"a":' * 1_000_000, b"[]", b"null", b"\xff\xfe", b"9" * 6000, b'{"a": 1, "a": 1}'],
    ids=["deep list", "deep object", "list", "null", "binary", "long number", "key twice"],
)
def test_what_is_no_memory_at_all_is_named(saved, content):
    (saved / "memory.json").write_bytes(content)
    is_named(saved, r"memory\.json", "memory.json")


@pytest.mark.parametrize("value", ["1e999", '{"a":' * 900 + "1" + "}" * 900])
def test_a_header_that_can_be_read_but_not_written_is_named(saved, value):
    text = (saved / "memory.json").read_text()
    (saved / "memory.json").write_text(text.replace('"n_entries": 2', f'"n_entries": {value}'))
    is_named(saved, r"memory\.json", "memory.json")


@pytest.mark.parametrize("kind", ["entries", "arrays"])
def test_files_of_two_checkpoints_do_not_mix(saved, tmp_path, kind):
    write_memory(a_memory(entries=a_memory().entries[::-1]), tmp_path / "other")
    other = (tmp_path / "other" / name_of(tmp_path / "other", kind)).read_bytes()
    (saved / name_of(saved, kind)).write_bytes(other)
    is_named(saved, "changed", name_of(saved, kind))


def test_nothing_that_is_not_finite_is_written(saved):
    for broken in (
        a_memory(robot=robot(open_width=float("nan"))),
        a_memory(entries=(entry(quality=float("nan")),)),
    ):
        with pytest.raises(ValueError, match="JSON"):
            write_memory(broken, saved)
    assert [e.quality for e in read_memory(saved).entries] == [0.9, 0.9]
