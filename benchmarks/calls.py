"""Watches a function while something else calls it: how often, and how long that took."""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Generator
from types import ModuleType
from typing import Any


@contextlib.contextmanager
def watched(module: ModuleType, name: str) -> Generator[list[float]]:
    """The seconds that every call of a module's function took, one after the other, while this is entered.

    Args:
        module: The module by whose name the function is called, not the one that defines it.
        name: Of the function.
    """
    function, spent_s = getattr(module, name), list[float]()

    @functools.wraps(function)
    def timed(*args: Any, **kwargs: Any) -> Any:
        begin_s = time.monotonic()
        try:
            return function(*args, **kwargs)
        finally:
            spent_s.append(time.monotonic() - begin_s)

    setattr(module, name, timed)
    try:
        yield spent_s
    finally:
        setattr(module, name, function)
