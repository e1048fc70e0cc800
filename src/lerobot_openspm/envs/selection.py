"""Which of a suite's tasks a user means."""

from collections.abc import Collection, Mapping


def names_in(spec: str) -> list[str]:
    """The names in what a user typed, which commas separate."""
    return [part.strip() for part in spec.split(",") if part.strip()]


def select(spec: str, tasks: Collection[str], groups: Mapping[str, Collection[str]], suite: str) -> list[str]:
    """Expand a task's name, a comma list of them or the name of a group into task names, in the order given.

    Args:
        spec: What the user typed.
        tasks: All names of tasks.
        groups: Names that stand for several tasks.
        suite: What errors call the suite.

    Raises:
        ValueError: A name is unknown, or there is none.
    """
    names = names_in(spec)
    if len(names) == 1 and names[0] in groups:
        return list(groups[names[0]])
    unknown = [name for name in names if name not in tasks]
    if unknown or not names:
        raise ValueError(
            f"unknown {suite} task {', '.join(unknown) or repr(spec)}; "
            f"expected {', '.join(map(repr, groups))} or a comma list of: {', '.join(tasks)}"
        )
    return names
