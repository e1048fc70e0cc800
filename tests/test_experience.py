import re

import numpy as np
import pytest
from tests.memory.builders import robot
from tests.memory.experiences import experience, same
from tests.memory.memory_files import edit_arrays, edit_entries, edit_header, name_of, names, vouch_for, write_texts
from tests.perception.builders import model

from lerobot_openspm.errors import MemoryFormatError, OpenSPMError
from lerobot_openspm.experience import VERSION, load_experience, save_experience


@pytest.fixture
def saved(tmp_path):
    save_experience(experience(), tmp_path)
    return tmp_path


def test_what_is_saved_is_loaded_to_the_last_bit(saved):
    assert same(load_experience(saved), experience())
    assert sorted(path.name for path in saved.iterdir()) == sorted(FILES)


def test_an_experience_without_entries_or_objects_survives_too(tmp_path):
    empty = experience(entries=(), objects={}, simulator_objects=())
    save_experience(empty, tmp_path / "new" / "folder")
    assert same(load_experience(tmp_path / "new" / "folder"), empty)


def test_equal_experiences_make_equal_files(saved, tmp_path):
    save_experience(load_experience(saved), tmp_path / "again")
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (saved / name).read_bytes()


def test_yaw_periods_are_those_of_the_objects():
    assert experience().yaw_periods == {
        "bowl": 2 * np.pi,
        "cream cheese box": np.pi,
        "stove": 2 * np.pi,
        "rack": np.pi,
        "mug": 2 * np.pi,
    }


def test_what_found_the_objects_is_remembered(tmp_path):
    made = experience(segmentation="given", shape="box")
    save_experience(made, tmp_path)
    assert same(load_experience(tmp_path), made)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_memories_from_before_segmenters_are_read(tmp_path, version):
    older = experience(objects={"bowl": model("bowl", 1), "stove": model("stove", 2)})
    save_experience(older, tmp_path)

    def age(memory):
        memory["version"] = version
        del memory["segmentation"], memory["shape"]
        for fields in memory["objects"]:
            del fields["foreground"]

    edit_json(tmp_path, age)
    loaded = load_experience(tmp_path)
    assert same(loaded, older)
    assert (loaded.segmentation, loaded.shape) == ("demonstrations", "demonstrations")


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(saved, name):
    (saved / name).unlink()
    with pytest.raises(OpenSPMError, match=re.escape(str(saved / name))):
        load_experience(saved)


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_at_any_length_is_noticed(saved, name):
    whole = (saved / name).read_bytes()
    for length in sorted({*range(0, len(whole), max(1, len(whole) // 60)), 1, 7, 8, 9, len(whole) - 1}):
        (saved / name).write_bytes(whole[:length])
        with pytest.raises(OpenSPMError, match=re.escape(str(saved / name))):
            load_experience(saved)


def test_a_flipped_byte_among_the_arrays_is_always_noticed(saved):
    path = saved / "memory.safetensors"
    whole = path.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 100).astype(int):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << (int(place) % 8)
        path.write_bytes(spoilt)
        with pytest.raises(MemoryFormatError, match="checksum"):
            load_experience(saved)


def test_a_flipped_byte_in_the_json_never_ends_in_another_error(saved):
    """People may edit the JSON, so no checksum guards it; but what is read from it is always sound."""
    path = saved / "memory.json"
    whole = path.read_bytes()
    refused, messages = 0, set()
    for place in np.linspace(0, len(whole) - 1, 150).astype(int):
        for bit in (0, 4, 7):
            spoilt = bytearray(whole)
            spoilt[place] ^= 1 << bit
            path.write_bytes(spoilt)
            try:
                loaded = load_experience(saved)
            except MemoryFormatError as error:
                refused += 1
                messages.add(str(error).split(":")[0])
            else:
                assert all(0 <= e.quality <= 1 and e.key_poses for e in loaded.entries)
                assert np.isfinite(loaded.robot.workspace).all()
                arrays = [p.T_obj_ee for e in loaded.entries for p in e.key_poses]
                assert same(
                    tuple(arrays), tuple(p.T_obj_ee for e in experience().entries for p in e.key_poses)
                )
    assert refused > 150
    assert all(message.startswith(str(saved)) for message in messages)


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


ENTRY = ("entries", 0)
POSE = (*ENTRY, "key_poses", 0)
AXIS = {"kind": "slide", "direction": [1.0, 0.0, 0.0], "amount": 0.1}
SPOILT = {
    "newer version": (setting("version", value=VERSION + 1), rf"version {VERSION + 1}.*upgrade"),
    "no version": (without("version"), "version None"),
    "version 0": (setting("version", value=0), "version 0"),
    "other format": (setting("format", value="zip"), "'zip'"),
    "no arrays": (without("arrays"), "arrays"),
    "arrays of another kind": (setting("arrays", value=[]), "malformed"),
    "no checksum": (without("arrays", "sha256"), "sha256"),
    "wrong checksum": (setting("arrays", "sha256", value="0" * 64), "checksum"),
    "no robot": (without("robot"), "robot"),
    "robot without gains": (without("robot", "metres_per_action"), "'robot'.*metres_per_action"),
    "robot NaN": (setting("robot", "open_width", value=float("nan")), "'robot'"),
    "robot beyond floats": (setting("robot", "open_width", value=10**400), "'robot'"),
    "workspace of another shape": (setting("robot", "workspace", value=[[0, 0, 0]]), "'robot'"),
    "no perception": (without("perception"), "perception"),
    "no simulator objects": (without("simulator_objects"), "simulator_objects"),
    "unknown segmentation": (setting("segmentation", value="magic"), "segmentation is 'magic'.*sam3"),
    "unknown shape": (setting("shape", value=["box"]), r"shape is \['box'\], expected one of demonstr"),
    "a box of no size": (setting("objects", 3, "size", value=[0, 0, 0]), "'size'"),
    "a box without a side": (without("objects", 3, "size", 0), "'size'.*'rack'"),
    "a shape without its foreground": (without("objects", 4, "foreground"), "log_odds"),
    "entries of another kind": (setting("entries", value={}), "'entries'"),
    "objects of another kind": (setting("objects", value={}), "'objects'"),
    "an object of another kind": (setting("objects", 0, value=3), "'objects'"),
    "an object renamed": (setting("objects", 0, "name", value="cup"), "log_odds"),
    "an object without a name": (without("objects", 0, "name"), "name"),
    "an entry of another kind": (setting(*ENTRY, value=7), r"entries\[0\]"),
    "an entry that is text": (setting(*ENTRY, value="bowl"), r"entries\[0\]"),
    "entry without language": (without(*ENTRY, "language"), r"entries\[0\].*language"),
    "quality beyond 1": (setting(*ENTRY, "quality", value=1.5), r"entries\[0\].*quality"),
    "quality NaN": (setting(*ENTRY, "quality", value=float("nan")), r"entries\[0\].*quality"),
    "quality text": (setting(*ENTRY, "quality", value="good"), r"entries\[0\]"),
    "version beyond integers": (setting(*ENTRY, "version", value=float("inf")), r"entries\[0\]"),
    "key of another kind": (setting(*ENTRY, "key", value=None), r"entries\[0\]"),
    "no sub-task": (setting(*ENTRY, "key", "sub_tasks", value=[]), r"entries\[0\].*sub-task"),
    "sub-task that is text": (setting(*ENTRY, "key", "sub_tasks", value=["put"]), r"entries\[0\]"),
    "sub-task with another field": (
        setting(*ENTRY, "key", "sub_tasks", 0, "speed", value="1"), r"entries\[0\].*speed",
    ),
    "no key pose": (setting(*ENTRY, "key_poses", value=[]), r"entries\[0\]"),
    "key pose that is text": (setting(*POSE, value="grasp"), r"entries\[0\]"),
    "one key pose less": (without(*POSE), "do not belong together|entries"),
    "layout of another kind": (setting(*ENTRY, "layout", value=3), r"entries\[0\]"),
    "one object less": (without(*ENTRY, "layout", 0), r"entries\[0\].*'bowl'"),
    "one object more": (setting(*ENTRY, "layout", value=["a", "b", "c", "d"]), r"entries\[0\]"),
    "unknown phase": (setting(*POSE, "phase", value="dance"), r"entries\[0\].*'dance'"),
    "confidence below 0": (setting(*POSE, "confidence", value=-0.1), r"entries\[0\].*confidence"),
    "opening NaN": (setting(*POSE, "opening", value=float("nan")), r"entries\[0\].*opening"),
    "opening infinite": (setting(*POSE, "opening", value=float("inf")), r"entries\[0\].*opening"),
    "closed as number": (setting(*POSE, "closed", value=1), r"entries\[0\].*'closed'"),
    "steps beyond integers": (setting(*POSE, "n_steps", value=float("inf")), r"entries\[0\]"),
    "anchor that is nowhere": (setting(*POSE, "anchor", "place", value="cup"), r"entries\[0\].*'cup'"),
    "anchor as text": (setting(*POSE, "anchor", value="bowl"), r"entries\[0\]"),
    "axis of no kind": (setting(*POSE, "axis", value=AXIS | {"kind": "bend"}), r"entries\[0\].*'bend'"),
    "axis of 2 numbers": (setting(*POSE, "axis", value=AXIS | {"direction": [1, 0]}), r"entries\[0\].*unit"),
    "axis too long": (setting(*POSE, "axis", value=AXIS | {"direction": [1, 1, 0]}), r"entries\[0\].*unit"),
    "axis NaN": (setting(*POSE, "axis", value=AXIS | {"amount": float("nan")}), r"entries\[0\].*amount"),
    "axis without amount": (setting(*POSE, "axis", value={"kind": "turn"}), r"entries\[0\]"),
    "anchor without axes": (without(*POSE, "anchor", "axes"), r"entries\[0\].*axes"),
}  # fmt: skip


@pytest.mark.parametrize("name", SPOILT)
def test_a_spoilt_memory_names_file_and_field(saved, name):
    change, words = SPOILT[name]
    edit_json(saved, change)
    with pytest.raises(MemoryFormatError, match=words) as caught:
        load_experience(saved)
    assert str(saved) in str(caught.value)


def recast(array, convert):
    return lambda arrays: arrays.update({array: convert(arrays[array]).copy()})


def spoil(array, index, value):
    def change(arrays):
        spoilt = arrays[array].copy()
        spoilt[index] = value
        arrays[array] = spoilt

    return change


POINTS, LOG_ODDS = "objects.bowl.points", "objects.bowl.log_odds"
ARRAYS = {
    "scaled pose": (spoil(KEY_POSE_ARRAY, (1, 0, 0), 1.5), KEY_POSE_ARRAY),
    "NaN pose": (spoil(KEY_POSE_ARRAY, (1, 0, 3), np.nan), KEY_POSE_ARRAY),
    "huge pose": (spoil(KEY_POSE_ARRAY, (1, 0, 0), 1e300), KEY_POSE_ARRAY),
    "mirrored layout": (spoil(LAYOUT_ARRAY, (0, slice(None), 2), [0, 0, -1, 0]), LAYOUT_ARRAY),
    "float32 poses": (recast(KEY_POSE_ARRAY, lambda T: T.astype(np.float32)), KEY_POSE_ARRAY),
    "integer poses": (recast(KEY_POSE_ARRAY, lambda T: T.astype(np.int64)), KEY_POSE_ARRAY),
    "flat poses": (recast(KEY_POSE_ARRAY, lambda T: T.reshape(-1, 16)), KEY_POSE_ARRAY),
    "no poses": (lambda a: a.pop(KEY_POSE_ARRAY), KEY_POSE_ARRAY),
    "one pose more": (
        recast(KEY_POSE_ARRAY, lambda T: np.concatenate([T, T])), "do not belong together",
    ),
    "one pose less": (recast(KEY_POSE_ARRAY, lambda T: T[:-1]), "entries"),
    "no points": (lambda a: a.pop(POINTS), "points"),
    "NaN points": (spoil(POINTS, (0, 0), np.nan), "points"),
    "double points": (recast(POINTS, lambda T: T.astype(np.float64)), "points"),
    "few colours": (recast(LOG_ODDS, lambda x: x[:5]), "log_odds"),
}  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_spoilt_arrays_are_named_even_if_somebody_vouches_for_them(saved, name):
    change, words = ARRAYS[name]
    edit_arrays(saved, change)
    with pytest.raises(MemoryFormatError, match=words) as caught:
        load_experience(saved)
    assert str(saved) in str(caught.value)


def test_arrays_that_are_no_safetensors_are_named(saved):
    for blob in (b"", b"hello", b"\xff" * 64, (10**15).to_bytes(8, "little") + b"{}"):
        vouch_for(saved, blob)
        with pytest.raises(MemoryFormatError, match="not safetensors"):
            load_experience(saved)


@pytest.mark.parametrize(
    "content",
    [b"[" * 200_000, b'{"a":' * 200_000, b"[]", b"null", b"\xff\xfe", b"9" * 6000],
    ids=["deep list", "deep object", "list", "null", "binary", "long number"],
)
def test_what_is_no_memory_at_all_is_named(saved, content):
    (saved / "memory.json").write_bytes(content)
    with pytest.raises(MemoryFormatError, match=re.escape(str(saved / "memory.json"))):
        load_experience(saved)


def test_files_of_two_checkpoints_do_not_mix(saved, tmp_path):
    other = experience(entries=experience().entries[::-1])
    save_experience(other, tmp_path / "other")
    (saved / "memory.safetensors").write_bytes((tmp_path / "other" / "memory.safetensors").read_bytes())
    with pytest.raises(MemoryFormatError, match="another checkpoint"):
        load_experience(saved)


def interrupt_at(monkeypatch, count):
    """Let the `count`-th renaming fail."""
    rename, done = os.replace, []

    def failing(source, target):
        done.append(target)
        if len(done) == count:
            raise OSError("power cut")
        rename(source, target)

    monkeypatch.setattr(os, "replace", failing)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_an_interrupted_save_leaves_the_old_experience_or_a_clear_error(saved, monkeypatch, count):
    newer = replace(experience(), entries=(entry("put the bowl on the plate", quality=0.1, source="new#1"),))
    with monkeypatch.context() as patched:
        interrupt_at(patched, count)
        with pytest.raises(OSError, match="power cut"):
            save_experience(newer, saved)
    if count == 1:
        assert same(load_experience(saved), experience())
    else:
        with pytest.raises(MemoryFormatError, match="checksum"):
            load_experience(saved)
    save_experience(newer, saved)
    assert same(load_experience(saved), newer)
    assert sorted(path.name for path in saved.iterdir()) == sorted(FILES)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_an_interrupted_first_save_is_no_experience(tmp_path, monkeypatch, count):
    with monkeypatch.context() as patched:
        interrupt_at(patched, count)
        with pytest.raises(OSError, match="power cut"):
            save_experience(experience(), tmp_path)
    with pytest.raises(MemoryFormatError, match=r"no memory at .*memory\.json"):
        load_experience(tmp_path)


def test_nothing_that_is_not_finite_is_written(saved):
    broken = experience(robot=robot(open_width=float("nan")))
    with pytest.raises(ValueError, match="JSON"):
        save_experience(broken, saved)
    assert [e.quality for e in load_experience(saved).entries] == [0.9, 0.9]
