import json

import numpy as np
import pytest
from tests.memory.builders import entry
from tests.memory.memories import same

from lerobot_openspm.memory.entry import WORLD, Anchor, Outcome
from lerobot_openspm.memory.fields import MALFORMED
from lerobot_openspm.memory.store import entry_from_fields, entry_to_fields

OUTCOME = Outcome(0, "bowl", Anchor("plate", WORLD), np.array([0.01, 0.0, 0.02]), np.zeros(3), 0.025)


def fields():
    return json.loads(json.dumps(entry_to_fields(entry(outcomes=(OUTCOME,)))))


def test_an_outcome_is_read_as_it_was_written():
    memory = entry(outcomes=(OUTCOME,))
    assert same(entry_from_fields(fields()), memory)


def test_an_entry_without_outcomes_says_nothing_of_them():
    assert "outcomes" not in entry_to_fields(entry())
    assert entry_from_fields(entry_to_fields(entry())).outcomes == ()


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"sub_task": 1}, "1 sub-tasks"),
        ({"target": "ghost"}, "not in its layout"),
        ({"anchor": {"place": "ghost", "axes": "ghost"}}, "not in its layout"),
        ({"position": [0.0, 1.0]}, "3 numbers"),
        ({"shown": [0.0, 1.0, float("nan")]}, "3 numbers"),
        ({"tolerance_m": -0.1}, "tolerance_m"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_malformed_outcome_is_an_error_that_names_it(change, error):
    broken = fields()
    broken["outcomes"][0].update(change)
    with pytest.raises(MALFORMED, match=error):
        entry_from_fields(broken)
