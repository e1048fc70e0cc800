import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.memory.builders import entry, robot
from tests.memory.memories import LAYOUTS, a_memory, merged_entry, same
from tests.memory.memory_files import names

from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.geometry.camera import cameras_to_dict
from lerobot_openspm.memory.io import read_memory, write_memory


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
    text = (saved / "memory.json").read_text()
    rows = json.loads(text)["entries"]
    assert [row["source"] for row in rows] == ["local/demos#0", "local/demos#1"]
    lines = text.splitlines()
    assert [json.loads(line.rstrip(",")) for line in lines[lines.index(' "entries": [') + 1 : -2]] == rows


def test_yaw_periods_are_those_of_the_objects():
    assert a_memory().yaw_periods == {
        "bowl": 2 * np.pi,
        "cream cheese box": np.pi,
        "stove": 2 * np.pi,
        "rack": np.pi,
        "mug": 2 * np.pi,
    }


def test_the_shapes_of_objects_are_not_used_in_the_simulators_frames():
    known = a_memory()
    assert set(known.points) == {"bowl", "cream cheese box", "rack", "mug"}  # the stove is known by patches
    oracle = a_memory(perception="oracle")
    assert oracle.points == {}
    assert oracle.symmetries == {}


def test_what_found_the_objects_is_remembered(tmp_path):
    made = a_memory(segmentation="given", shape="box")
    write_memory(made, tmp_path)
    assert same(read_memory(tmp_path), made)


@pytest.mark.parametrize("index", range(2))
def test_a_missing_file_is_named(saved, index):
    name = names(saved)[index]
    (saved / name).unlink()
    with pytest.raises(OpenSPMError, match=re.escape(str(saved / name))):
        read_memory(saved)


def test_another_calibration_may_be_used_instead(saved, tmp_path):
    file = tmp_path / "cameras.json"
    cameras = {key: replace(camera, fx=50.3) for key, camera in a_memory().cameras.items()}
    file.write_text(json.dumps(cameras_to_dict(cameras)))
    meant = read_memory(saved, cameras=file)
    assert meant.cameras["observation.images.front"].fx == 50.3
    write_memory(meant, saved)
    assert same(read_memory(saved), meant)


def test_nothing_that_is_not_finite_is_written(saved):
    for broken in (
        a_memory(robot=robot(open_width=float("nan"))),
        a_memory(entries=(entry(quality=float("nan")),)),
    ):
        with pytest.raises(ValueError, match="could never be loaded again, so nothing was saved"):
            write_memory(broken, saved)
    assert [e.quality for e in read_memory(saved).entries] == [0.9, 0.9]
