"""What the pages of results are made of: parts read from JSON, and tables."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def part(title: str, name: str, render: Callable[[dict[str, Any]], str], script: str) -> str:
    """One section, from one JSON file; says so where it is missing."""
    path = RESULTS / f"{name}.json"
    if not path.exists():
        return f"## {title}\n\nNot measured: `{path.name}` is missing; run `python -m benchmarks.{script}`."
    result = json.loads(path.read_text())
    return f"## {title}\n\n{render(result)}\n\n{origin(result)}"


def origin(result: dict[str, Any]) -> str:
    """What a result was measured on."""
    return (
        f"Commit `{result['commit']}`, {result['machine']['cores']} cores ({result['machine']['processor']})."
    )


def rates(runs: dict[str, Any]) -> str:
    """Success with its interval, a row each."""
    rows = [
        [name.replace("_", " "), percent(run), interval(run), run["n"], run["mean_steps"]]
        for name, run in runs.items()
    ]
    return table(["", "Success", "95 % interval", "Episodes", "Mean steps of successes"], rows)


def percent(run: dict[str, Any]) -> str:
    """A success rate."""
    return f"{100 * run['success']:.1f} %"


def interval(run: dict[str, Any]) -> str:
    """The interval of a success rate."""
    return f"{100 * run['interval'][0]:.1f} to {100 * run['interval'][1]:.1f} %"


def table(heads: list[str], rows: list[list[Any]]) -> str:
    """A table in Markdown; None is a dash."""
    lines = [heads, ["---"] * len(heads), *rows]
    cells = [["-" if cell is None else str(cell) for cell in line] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)
