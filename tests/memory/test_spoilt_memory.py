"""Files that somebody spoilt, or that are of another version, are refused with file and field."""

import json

import numpy as np
import pytest
from tests.memory.memories import a_memory
from tests.memory.memory_files import edit_arrays, edit_entries, edit_header, names, vouch_for, write_texts

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.memory.io import read_memory, write_memory
from lerobot_openspm.memory.schema import VERSION


@pytest.mark.parametrize(
    ("version", "do"), [(VERSION - 1, "train again: lerobot-train"), (VERSION + 1, "upgrade")]
)
def test_another_version_is_refused_in_one_line_whatever_else_the_file_holds(tmp_path, version, do):
    file = tmp_path / "memory.json"
    file.write_text(json.dumps({"format": "openspm-memory", "version": version, "something": "else"}))
    with pytest.raises(MemoryFormatError) as caught:
        read_memory(tmp_path)
    assert str(caught.value).startswith(f"{file}: got version {version}, expected {VERSION}; {do}")
    assert "\n" not in str(caught.value)


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
    "no version": (without("version"), "no memory: it begins with"),
    "version 0": (setting("version", value=0), "version 0"),
    "other format": (setting("format", value="zip"), "zip.*expected format 'openspm-memory'"),
    "no robot": (without("robot"), "robot"),
    "robot without gains": (without("robot", "metres_per_action"), r"metres_per_action` - at `\$\.robot`"),
    "robot NaN": (setting("robot", "open_width", value=float("nan")), "NaN is no JSON number"),
    "robot beyond floats": (
        setting("robot", "open_width", value=10**400),
        r"out of range - at `\$\.robot\.open",
    ),
    "workspace of another shape": (
        setting("robot", "workspace", value=[[0, 0, 0]]),
        r"length.*\$\.robot\.work",
    ),
    "no perception": (without("perception"), "perception"),
    "no simulator objects": (without("simulator_objects"), "simulator_objects"),
    "shape of another kind": (setting("shape", value=["box"]), r"got `array` - at `\$\.shape`"),
    "a box of no size": (setting("objects", 3, "size", value=[0, 0, 0]), "'size'"),
    "a box without a side": (without("objects", 3, "size", 0), "'size'.*'rack'"),
    "a shape without its foreground": (without("objects", 4, "foreground"), "'foreground' of 'mug'"),
    "objects of another kind": (setting("objects", value={}), r"at `\$\.objects`"),
    "an object of another kind": (setting("objects", 0, value=3), r"at `\$\.objects\[0\]`"),
    "an object renamed": (setting("objects", 0, "name", value="cup"), "log_odds"),
    "an object without a name": (without("objects", 0, "name"), "name"),
    "an unknown field": (setting("colour", value="red"), "unknown field `colour`"),
    "no arrays": (without("arrays"), "missing required field `arrays`"),
    "open width below 0": (setting("robot", "open_width", value=-1), r">= 0.0 - at `\$\.robot\.open_width`"),
    "a gain beyond robots": (setting("robot", "metres_per_action", value=1e300), "<= 1000.*metres_per_act"),
    "a speed below 0": (setting("robot", "metres_per_step", value=-0.1), "metres_per_step"),
    "workspace exchanged": (
        setting("robot", "workspace", value=[[0.5, 0.5, 0.5], [-0.5, 0.6, 0.6]]),
        "'workspace' of the 'robot' is .*the lowest",
    ),
    "workspace beyond robots": (
        setting("robot", "workspace", value=[[0, 0, 0], [1e300, 1, 1]]),
        r"\$\.robot\.workspace\[1\]\[0\]",
    ),
    "an object twice": (
        lambda header: header["objects"].append(header["objects"][0]),
        "'objects' has 'bowl' twice",
    ),
    "a file somewhere else": (setting("arrays", value="../a.safetensors"), r"at `\$\.arrays`"),
    "a file that there is not": (setting("arrays", value=f"memory-{'0' * 64}.safetensors"), "no memory at"),
    "no calibration": (without("cameras"), "`cameras`"),
    "more entries than there are": (setting("n_entries", value=3), "'n_entries' is 3, but it holds 2"),
    "entries below 0": (setting("n_entries", value=-1), "n_entries"),
    "an anchor that is not listed": (setting("anchored", value=["bowl"]), r"entries\[0\].*'plate'"),
    "layouts of another kind": (setting("layouts", value=["state"]), r"at `\$\.layouts`"),
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
        "value 'bent'.*rotation",
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
    "no sub-task": (setting(*ENTRY, "key", "sub_tasks", value=[]), r"entries\[0\].*sub_tasks"),
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
    "closed as number": (setting(*POSE, "closed", value=1), r"entries\[0\].*key_poses\[0\]\.closed"),
    "steps beyond integers": (setting(*POSE, "n_steps", value=float("inf")), r"entries\[0\]"),
    "anchor that is nowhere": (setting(*POSE, "anchor", "place", value="cup"), r"entries\[0\].*'cup'"),
    "anchor as text": (setting(*POSE, "anchor", value="bowl"), r"entries\[0\]"),
    "axis of no kind": (setting(*POSE, "axis", value=AXIS | {"kind": "bend"}), r"entries\[0\].*'bend'"),
    "axis of 2 numbers": (setting(*POSE, "axis", value=AXIS | {"direction": [1, 0]}), "axis.direction"),
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
    "object poses of another kind": (setting(*ENTRY, "object_poses", value=3), r"entries\[0\]"),
    "one object less": (without(*ENTRY, "object_poses", "bowl"), r"entries\[0\].*'bowl'"),
    "a sub-task there is not": (setting(*POSE, "sub_task", value=1), r"entries\[0\].*'sub_task' is 1"),
    "pose as text": (setting(*POSE, "T_obj_ee", value="here"), r"entries\[0\].*T_obj_ee"),
    "pose of texts": (setting(*POSE, "T_obj_ee", value=[["1"] * 4] * 3), r"entries\[0\].*T_obj_ee"),
    "ragged pose": (setting(*POSE, "T_obj_ee", value=[[1, 0], [0, 1, 0]]), r"entries\[0\].*T_obj_ee"),
    "pose of two rows": (without(*POSE, "T_obj_ee", 0), r"entries\[0\].*T_obj_ee"),
    "scaled pose": (setting(*POSE, "T_obj_ee", 0, 0, value=1.5), r"entries\[0\].*T_obj_ee.*rigid"),
    "huge pose": (setting(*POSE, "T_obj_ee", 0, 0, value=1e300), r"entries\[0\].*<= 1000000000.0.*T_obj_ee"),
    "null in a pose": (setting(*POSE, "T_obj_ee", 0, 3, value=None), r"entries\[0\].*T_obj_ee"),
    "mirrored object poses": (
        setting(*ENTRY, "object_poses", "bowl", 2, value=[0, 0, -1, 0]),
        r"entries\[0\].*'object_poses'",
    ),
    "source with half a character": (
        setting(*ENTRY, "source", value="a\ud800"),
        r"of printable characters, not empty - at `\$\.source`",
    ),
    "source that a terminal obeys": (setting(*ENTRY, "source", value="a\x1b[2J"), r"\$\.source"),
    "source of two lines": (setting(*ENTRY, "source", value="a\nb"), r"\$\.source"),
    "no source": (setting(*ENTRY, "source", value=""), r"not empty - at `\$\.source`"),
    "no language": (setting(*ENTRY, "language", value=" "), r"entries\[0\].*not empty - at `\$\.language`"),
    "language with half a character": (setting(*ENTRY, "language", value="put \udfff"), r"\$\.language"),
    "layout with half a character": (
        lambda rows: rows[0]["object_poses"].update({"a\ud800": rows[0]["object_poses"]["bowl"]}),
        r"at `key` in `\$\.object_poses`",
    ),
    "landmarks with half a character": (
        setting(*SUB_TASK, "target_where", value={"relation": "on", "landmarks": ["a\ud800"]}),
        r"target_where\.landmarks\[0\]",
    ),
    "trials beyond counting": (setting(*ENTRY, "trials", value=10**400), r"<= 1000000000 - at `\$\.trials`"),
    "steps beyond counting": (setting(*POSE, "n_steps", value=10**400), r"<= 1000000000.*n_steps"),
    "version beyond counting": (
        setting(*ENTRY, "version", value=10**10),
        r"<= 1000000000 - at `\$\.version`",
    ),
    "opening beyond grippers": (setting(*POSE, "opening", value=-1e308), r">= -1000000000.*opening"),
    "place beyond tables": (
        setting(*POSE, "T_obj_ee", 0, 3, value=1e300),
        r"<= 1000000000.0.*T_obj_ee\[0\]\[3\]",
    ),
    "no operation": (setting(*SUB_TASK, "operation", value=""), "operation"),
    "operation of two lines": (setting(*SUB_TASK, "operation", value="put\n"), "operation"),
    "operation without end": (setting(*SUB_TASK, "operation", value="a" * 1001), "<= 1000.*operation"),
    "own words without words": (
        setting(*SUB_TASK, "operation", value="do"),
        "'words' '', expected words where",
    ),
    "words of another operation": (
        setting(*SUB_TASK, "words", value="do it"),
        "'words' 'do it', expected words",
    ),
    "another key than the kept one": (setting(*SUB_TASK, "relation", value="in"), "another key or quality"),
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
    is_named(saved, words, "memory.json")


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
        ([b"7"], "Expected `object`"),
    ],
)
def test_a_line_that_is_no_entry_is_named(saved, texts, words):
    write_texts(saved, texts)
    edit_header(saved, lambda header: header.update(n_entries=len(texts)))
    is_named(saved, words, "memory.json: entries[0]")


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
        is_named(saved, "not safetensors", names(saved)[1])


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


def test_files_of_two_checkpoints_do_not_mix(saved, tmp_path):
    write_memory(a_memory(entries=a_memory().entries[::-1]), tmp_path / "other")
    (saved / names(saved)[1]).write_bytes((tmp_path / "other" / names(tmp_path / "other")[1]).read_bytes())
    is_named(saved, "changed", names(saved)[1])
