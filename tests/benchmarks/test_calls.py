"""A function that is watched does what it did, and is left as it was."""

from types import ModuleType

import pytest
from benchmarks.calls import watched


def divide(a: float, b: float) -> float:
    return a / b


def test_every_call_is_noted_and_the_function_is_put_back_whatever_happens():
    module = ModuleType("some")
    module.divide = divide
    with watched(module, "divide") as spent_s:
        assert module.divide(1, b=2) == 0.5
        with pytest.raises(ZeroDivisionError):
            module.divide(1, 0)
    assert len(spent_s) == 2
    assert all(0 <= s < 1 for s in spent_s)
    with pytest.raises(ZeroDivisionError), watched(module, "divide"):
        module.divide(1, 0)
    assert module.divide is divide
