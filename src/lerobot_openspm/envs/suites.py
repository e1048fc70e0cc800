"""The suites that can be recorded. A new one is a folder like `tabletop`, a function here, and its name."""

from __future__ import annotations

from collections.abc import Callable

from lerobot_openspm.envs.recording import Suite


def _tabletop(_: str) -> Suite:
    from lerobot_openspm.envs.tabletop.recording import Tabletop

    return Tabletop()


def _libero(selection: str) -> Suite:
    from lerobot_openspm.envs.libero.recording import LiberoSuite, selected_suite

    return LiberoSuite(selected_suite(selection))


# By the name that --env.type takes, of the tasks that --env.task selects. A suite's simulator is imported
# only if it is asked for.
SUITES: dict[str, Callable[[str], Suite]] = {"openspm_tabletop": _tabletop, "libero": _libero}


def find_suite(env_type: str, selection: str = "all") -> Suite:
    """The suite that some tasks of an environment type are of.

    Args:
        env_type: As --env.type takes it.
        selection: The tasks, as --env.task takes them.

    Raises:
        ValueError: There is no such suite, or the tasks are of several.
    """
    if env_type not in SUITES:
        raise ValueError(f"env.type is {env_type!r}, expected {' or '.join(SUITES)}")
    return SUITES[env_type](selection)


def whole_suite(env_type: str, selection: str) -> str:
    """All tasks of the suite that some are of, as --env.task takes them. Raises as :func:`find_suite`."""
    name = find_suite(env_type, selection).name
    return "all" if name == env_type else name
