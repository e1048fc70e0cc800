"""What the pages of results are made of: sections read from JSON, each with marks of what it quotes."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from benchmarks.results import PROVENANCE
from benchmarks.staleness import ROOT, read_result

NO_FIGURES = {*PROVENANCE, "interval"}
# By a figure's command: of which commit's result films were looked at, and what they show. An episode is
# known by its initial state, or by its seed where scenes are drawn. Where films are of an earlier run, in
# which the same episodes failed for the same reasons, `filmed` is the commit of that.
LOOKED_AT = ROOT / "docs/looked_at.json"
# In which the default differs from the paper, beside any figure that compares ways of following key poses.
STRAIGHT = (
    "`closed_loop_trc` also goes straight where nothing is pushed, pulled or turned; there the flow model is "
    "not asked. In the other two it gives every way."
)


class Quoted(dict[str, Any]):
    """A result that notes which of its figures are read."""

    def __init__(self, name: str, content: dict[str, Any]) -> None:
        super().__init__(content)
        self.name, self.read = name, dict[str, None]()

    def __getitem__(self, key: str) -> Any:
        if key not in NO_FIGURES:
            self.read[key] = None
        return super().__getitem__(key)

    @property
    def marks(self) -> str:
        """One comment for every figure that was read; `scripts/stale_figures.py` looks for them."""
        return " ".join(f"<!-- figure: {self.name}.{key} -->" for key in self.read)


def quoted(name: str) -> Quoted | None:
    """A result to quote from; None if it was not measured."""
    content = read_result(name)
    return None if content is None else Quoted(name, content)


def section(title: str, names: str | Sequence[str], render: Callable[..., str]) -> str:
    """A section made of one result, or of those of several that are there; empty if none is.

    Args:
        title: Its heading.
        names: The result that `render` gets, or the results that it gets a list of.
        render: Makes the text.
    """
    single = isinstance(names, str)
    found = [one for name in ([names] if single else names) if (one := quoted(name)) is not None]
    if not found:
        return ""
    text = render(found[0] if single else found)
    marks = "\n".join(one.marks for one in found)
    return f"## {title}\n{marks}\n\n{text}\n\n{'\n'.join(dict.fromkeys(_origin(one) for one in found))}"


def chapter(introduction: str, sections: Iterable[str]) -> list[str]:
    """The sections that there are, below their introduction; nothing if there are none."""
    there = [one for one in sections if one]
    return [introduction, *there] if there else []


def _origin(result: dict[str, Any]) -> str:
    machine, command = result["machine"], result["command"]
    changed = ", with changes that are not in it" if result["dirty"] else ""
    return (
        f"`{command}` on {result['date'][:10]}, commit `{result['commit']}`{changed}; "
        f"{machine['cores']} cores of {machine['cpu']}."
    )


def looked_at(result: Quoted) -> str:
    """What films of the failed episodes show; nothing where those of the result were not looked at."""
    looked = json.loads(LOOKED_AT.read_text()).get(result["command"], {})
    if looked.get("commit") != result["commit"] or not looked["failed"]:
        return ""
    episodes = "Seeds" if "seeds" in looked["failed"][0] else "States"
    rows = [
        [
            one["task"].replace("_", " "),
            ", ".join(map(str, one[episodes.lower()])),
            one["kind"],
            one["seen"],
        ]
        for one in looked["failed"]
    ]
    kinds = Counter(one["kind"] for one in looked["failed"] for _ in one[episodes.lower()])
    counted = ", ".join(f"{kind} {n}" for kind, n in kinds.most_common())
    heads = ["Task", episodes, "Failed by", "What is seen"]
    earlier = looked.get("filmed")
    of = f" in the run of commit `{earlier}`, where the same failed for the same reasons" if earlier else ""
    return f"\n\nBy a look at a film of each{of}: {counted}.\n\n{table(heads, rows)}"


def percent(run: dict[str, Any]) -> str:
    """A success rate; a dash for none of no episodes."""
    return share(run["success"])


def share(fraction: float | None) -> str:
    """A fraction of the episodes in percent; a dash for none of no episodes."""
    return "-" if fraction is None else f"{100 * fraction:.1f} %"


def interval(run: dict[str, Any]) -> str:
    """The interval of a success rate; a dash for that of no episodes."""
    low, high = (100 * bound for bound in run["interval"] or (0, 0))
    return "-" if run["interval"] is None else f"{low:.1f} to {high:.1f} %"


# A column: its head, and the key of its values or what makes them of a row.
type Columns = Mapping[str, str | Callable[[dict[str, Any]], Any]]
SUCCESS: Columns = {"Success": percent, "95 % interval": interval, "Episodes": "n"}
STEPS: Columns = {**SUCCESS, "Mean steps of successes": "mean_steps"}


def grid(rows: Mapping[str, dict[str, Any]], columns: Columns, head: str = "") -> str:
    """A table in Markdown of named rows; underscores of a name are blanks."""
    cells = [
        [
            name.replace("_", " "),
            *(row[one] if isinstance(one, str) else one(row) for one in columns.values()),
        ]
        for name, row in rows.items()
    ]
    return table([head, *columns], cells)


def table(heads: list[str], rows: list[list[Any]]) -> str:
    """A table in Markdown; None is a dash."""
    lines = [heads, ["---"] * len(heads), *rows]
    cells = [["-" if cell is None else str(cell) for cell in line] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)
