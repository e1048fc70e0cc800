"""The suites that can be recorded. A new one is a folder like `tabletop`, a function here, and its name."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

from lerobot_openspm.envs.recording import Suite


def _tabletop() -> Suite:
    from lerobot_openspm.envs.tabletop.recording import Tabletop

    return Tabletop()


def _libero() -> Suite:
    from lerobot_openspm.envs.libero.recording import LiberoGoal

    return LiberoGoal()


# By the name that --env.type takes. A suite's simulator is imported only if it is asked for.
SUITES: dict[str, Callable[[], Suite]] = {"openspm_tabletop": _tabletop, "libero": _libero}


def find_suite(env_type: str) -> Suite:
    """The suite of an environment type.

    Raises:
        ValueError: There is no such suite.
    """
    if env_type not in SUITES:
        raise ValueError(f"env.type is {env_type!r}, expected {' or '.join(SUITES)}")
    return SUITES[env_type]()


def has_libero() -> bool:
    """Whether LIBERO is installed."""
    return find_spec("libero") is not None
