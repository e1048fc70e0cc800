from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from tests.memory.builders import entry, robot
from tests.memory.memories import a_memory, same
from tests.perception.builders import model

from lerobot_openspm.errors import MemoryFormatError


def test_appending_adds_entries_and_objects_and_keeps_known_ones():
    old = a_memory()
    newer = a_memory(
        entries=(entry(source="local/more#0"),),
        objects={"bowl": model("bowl", 9), "plate": model("plate", 3)},
        robot=robot(open_width=0.5),
    )
    both = old.appended(newer)
    assert [e.source for e in both.entries] == ["local/demos#0", "local/demos#1", "local/more#0"]
    assert set(both.objects) == {"bowl", "cream cheese box", "stove", "rack", "mug", "plate"}
    # The old entries are anchored in the old model's frame.
    assert_array_equal(both.objects["bowl"].points, old.objects["bowl"].points)
    assert same(both.robot, old.robot)
    assert same(both.cameras, old.cameras)


def test_appending_the_same_episode_again_replaces_its_entry():
    old = a_memory()
    newer = replace(old, entries=(entry(quality=0.3, source="local/demos#0"),))
    both = old.appended(newer)
    assert [(e.source, e.quality) for e in both.entries] == [("local/demos#1", 0.9), ("local/demos#0", 0.3)]


def test_appending_widens_the_workspace_and_counts_versions_up():
    low, high = np.array([-0.1, -0.2, 0.1]), np.array([0.9, 0.2, 0.4])
    old = a_memory()
    both = old.appended(replace(old, entries=old.entries[:1], robot=robot(workspace=np.stack([low, high]))))
    assert_array_equal(both.robot.workspace[0], np.minimum(old.robot.workspace[0], low))
    assert_array_equal(both.robot.workspace[1], np.maximum(old.robot.workspace[1], high))
    assert [e.version for e in both.entries] == [1, 2]


def test_appending_from_another_robot_is_refused():
    old = a_memory()
    other = replace(old, robot=robot(close_command=-1.0, open_command=1.0))
    with pytest.raises(MemoryFormatError, match=r"close_command is -1, the memory's 1.*rebuild"):
        old.appended(other)
