import numpy as np
import pytest

from lerobot_openspm.control.reasons import why_missing
from lerobot_openspm.types import PoseEstimate


@pytest.mark.parametrize(
    ("status", "seen", "words"),
    [
        ("not_found", {"tipped": True}, "the bowl has tipped over"),
        ("ambiguous", {}, "cannot tell which bowl is meant"),
        ("not_found", {}, "cannot find the bowl: it is in no view"),
        ("found", {"visible": 0.4}, "no view shows more than 40 % of the bowl"),
    ],
)
def test_each_missing_object_is_named_with_what_is_known_of_it(status, seen, words):
    estimate = PoseEstimate(status, np.eye(4), np.eye(4), 0.0, **seen)
    told = why_missing(["bowl", "plate"], {"bowl": estimate}, {}, is_something_held=False)
    assert told.startswith(words)
    assert "cannot find the plate" in told
    assert "fingers" not in told


def test_the_only_one_that_was_found_is_said_to_be_elsewhere():
    estimate = PoseEstimate("not_found", np.eye(4), np.eye(4), 1.0)
    told = why_missing(["bowl"], {"bowl": estimate}, {"bowl": "is not on the plate"}, is_something_held=False)
    assert told == "the only bowl that was found is not on the plate"


def test_what_is_missing_may_be_in_the_hand():
    told = why_missing(["bowl"], {}, {}, is_something_held=True)
    assert told.endswith("the fingers are around something, which may be it")
