import json

import numpy as np
import pytest
from tests.memory.builders import entry
from tests.memory.memories import merged_entry, same

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.memory.entry import WORLD, Anchor, Outcome
from lerobot_openspm.memory.schema import entry_from_json, entry_to_json, loads

OUTCOME = Outcome(
    0, "bowl", Anchor("plate", WORLD), np.array([0.01, 0.0, 0.02]), np.zeros(3), 0.025, (0.03, -0.01)
)


def test_an_entry_is_read_as_it_was_written():
    for one in (entry(outcomes=(OUTCOME,)), merged_entry(trials=3, successes=1), entry("fold it, would you")):
        assert same(entry_from_json(entry_to_json(one), "here"), one)


def test_what_is_not_known_is_not_written():
    assert b"outcomes" in entry_to_json(entry(outcomes=(OUTCOME,)))
    assert not any(word in entry_to_json(entry()) for word in (b"outcomes", b"null", b"trials", b"words"))


def test_every_number_is_read_to_the_last_bit():
    numbers = np.frombuffer(np.random.default_rng(0).bytes(80_000), np.float64)
    numbers = numbers[np.abs(numbers) <= 1e9]
    for x, y, z in numbers[: len(numbers) // 3 * 3].reshape(-1, 3)[:300]:
        outcome = Outcome(0, "bowl", Anchor("plate", WORLD), np.array([x, y, z]), np.array([-0.0, z, x]), 0.0)
        (found,) = entry_from_json(entry_to_json(entry(outcomes=(outcome,))), "here").outcomes
        assert found.position.tobytes() == outcome.position.tobytes()
        assert found.shown.tobytes() == outcome.shown.tobytes()


def test_among_many_keys_the_one_that_is_there_twice_is_found_at_once():
    text = json.dumps({f"key {i}": 0 for i in range(200_000)})[:-1] + ', "key 199999": 1}'
    with pytest.raises(MemoryFormatError, match=r"here: .*key 'key 199999' twice"):
        loads(text.encode(), "here")


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"sub_task": 1}, "1 sub-tasks"),
        ({"target": "ghost"}, "not in its 'object_poses'"),
        ({"anchor": {"place": "ghost", "axes": "ghost"}}, "not in its 'object_poses'"),
        ({"position": [0.0, 1.0]}, r"\$\.outcomes\[0\]\.position"),
        ({"shown": [0.0, 1.0, None]}, r"\$\.outcomes\[0\]\.shown\[2\]"),
        ({"tolerance_m": -0.1}, "tolerance_m"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_malformed_outcome_is_an_error_that_names_it(change, error):
    broken = json.loads(entry_to_json(entry(outcomes=(OUTCOME,))))
    broken["outcomes"][0].update(change)
    with pytest.raises(MemoryFormatError, match=rf"here: malformed: .*{error}"):
        entry_from_json(json.dumps(broken).encode(), "here")
