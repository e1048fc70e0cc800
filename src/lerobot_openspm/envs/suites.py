"""The suites that can be recorded. A new one is a folder like `tabletop`, a function here, and its name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from lerobot_openspm.envs.recording import Suite


def _tabletop() -> Suite:
    from lerobot_openspm.envs.tabletop.recording import Tabletop

    return Tabletop()


def _libero(suite: str) -> Suite:
    from lerobot_openspm.envs.libero.recording import LiberoSuite

    return LiberoSuite(suite)


# By the name that --env.type takes. A suite's simulator is imported only if it is asked for.
SUITES: dict[str, Callable[[], Suite]] = {
    "openspm_tabletop": _tabletop,
    "libero": partial(_libero, "libero_goal"),
    "libero_spatial": partial(_libero, "libero_spatial"),
    "libero_object": partial(_libero, "libero_object"),
    "libero_10": partial(_libero, "libero_10"),
}


def find_suite(env_type: str) -> Suite:
    """The suite of an environment type.

    Raises:
        ValueError: There is no such suite.
    """
    if env_type not in SUITES:
        raise ValueError(f"env.type is {env_type!r}, expected {' or '.join(SUITES)}")
    return SUITES[env_type]()
