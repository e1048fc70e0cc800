"""Writes ``docs/results.md`` and README's figures from ``benchmarks/results``; measures nothing itself.

    python -m benchmarks.tables [--current]

What was not measured is left out. With ``--current`` results that are stale or cannot be taken again are
deleted first.
"""

import argparse
from pathlib import Path
from typing import Any

from benchmarks.figures import FIGURES, OTHER_SUITES
from benchmarks.libero.tables import libero_sections
from benchmarks.markdown import (
    STEPS,
    STRAIGHT,
    SUCCESS,
    Columns,
    Quoted,
    chapter,
    grid,
    interval,
    looked_at,
    percent,
    quoted,
    section,
    share,
    table,
)
from benchmarks.memory_tables import memory_sections
from benchmarks.perception_tables import perception_sections
from benchmarks.staleness import ROOT, origin, read_result
from lerobot_openspm.cli.pipeline import rate

INTRODUCTION = """# Results

Made by `python -m benchmarks.tables` from `benchmarks/results`. `python -m benchmarks.figures tracking`
takes a figure anew, `python scripts/stale_figures.py` says which ones the code has left behind. Rates come
with 95 % Wilson intervals."""
TABLETOP = """# On the tabletop

From ten demonstrations a task unless said otherwise, on seeds that no demonstration and no tuning used. The
ten tasks share their scenes seed by seed."""
RUN_BEFORE = (
    "The same episodes were run on earlier code too. Films of those that failed were looked at; what was "
    "mended was tried on other seeds."
)
NOTES = {
    "compound": "The ten tasks were demonstrated, these never were: each is carried out by memories of its "
    f"parts, one after another, with 300 steps for each part. {RUN_BEFORE}",
    "combinations": "The ten tasks show how each of these things is grasped and how each of these places is "
    "used. None of these instructions was demonstrated: a grasp of one demonstration and a place of another "
    "are put together. Only the bowl was put in the drawer, in a task that says to open it first. The drawer "
    "is shut at first, also where the instruction does not say so. 300 steps for each part, opening the "
    "drawer among them. Where a task needs room the layouts are drawn with it: a box that goes into the "
    "drawer stands beside the way of the drawers, and no plate stands before the stove where something else "
    "goes. The other layouts are drawn as for the ten tasks. "
    f"{RUN_BEFORE}",
    "preconditions": "The tasks among the new combinations whose drawer is shut and whose instruction does "
    "not say to open it, in scenes of their own, drawn as there. An episode succeeds if the thing is in the "
    "drawer at the end, which asks for more than the drawer being opened. "
    f"{RUN_BEFORE}",
    "two_bowls": "No demonstration shows two bowls; which one is meant is told from where the objects are.",
    "anywhere": "Every object stands within 25 cm of the table's middle at any yaw, beside two distractors "
    "of the colours of bowl and box and a second object of the kind, or a second bowl where the task is a "
    "drawer or a stove, from the usual demonstrations. Layouts are drawn so that nothing touches, the hand "
    "has room around what can be grasped, the way of a drawer or a push that is asked for is free and in "
    "reach, and the words leave no doubt (left and right by 12 cm). Of these one is used only if some camera "
    "shows half of each of the two objects of the same kind, and the scripted expert reaches the goal in it; "
    "else another one is drawn. The same episodes were run twice before. Why they failed was read from "
    "them; what was mended for it was tried on other seeds.",
}
PAGE, README = ROOT / "docs/results.md", ROOT / "README.md"
# What stands between these lines of README is written here.
BEGIN, END = "<!-- figures: written by python -m benchmarks.tables -->", "<!-- end of figures -->"


def write_pages() -> None:
    """Write both pages from the results that are there."""
    PAGE.write_text(results_page())
    README.write_text(with_headlines(README.read_text()))


def results_page() -> str:
    """All that was measured, and how to measure the rest."""
    parts = [
        INTRODUCTION,
        *chapter(TABLETOP, tabletop_sections()),
        *libero_sections(),
        *perception_sections(),
        *memory_sections(),
    ]
    missing = {name: figure.command for name, figure in FIGURES.items() if read_result(name) is None}
    if missing:
        lines = "\n".join(f"- {name}: `{command}`" for name, command in missing.items())
        parts.append(f"# Not measured on the present code\n\n{lines}")
    return "\n\n".join(parts) + "\n"


def tabletop_sections() -> list[str]:
    """Success rates on the tabletop."""
    parts = "Instructions of which only the parts were demonstrated, from pixels"
    return [
        section("The ten tasks, from pixels", "tabletop", _demo),
        section("How key poses are followed, from pixels", "execution", _execution),
        section("Object poses from the simulator (oracle)", "oracle", _with_tasks),
        section("What the flow model is told, from pixels", "conditioning", _conditioning),
        section(parts, "compound", _selection),
        section("New combinations of a thing and a place, from pixels", "combinations", _selection),
        section("A drawer that nobody says is shut, from pixels", "preconditions", _selection),
        section("Which of two bowls is meant, from pixels", "two_bowls", _selection),
        section("Everything anywhere, with distractors, from pixels", "anywhere", _anywhere),
    ]


def with_headlines(text: str) -> str:
    """README with its table of figures written anew.

    Raises:
        ValueError: The lines that the table stands between are not there.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(
            f"README.md has no place for its figures; put these lines into it: {BEGIN} and {END}"
        )
    return f"{before}{BEGIN}\n{_headlines()}\n{END}{after}"


def _headlines() -> str:
    """The rows whose results are there."""
    rows = [
        _headline("Tabletop", "tabletop", "train_s"),
        _taught("Tabletop, a task taught to a trained policy"),
        *(
            _headline("LIBERO-GOAL", name, "mine_and_train_s")
            for name in ("libero_goal", "libero_few_shot_3", "libero_few_shot_1")
        ),
        *(_headline(suite.upper().replace("_", "-"), suite, "mine_and_train_s") for suite in OTHER_SUITES),
        _headline("LIBERO-PRO, objects exchanged", "libero_goal_swap"),
        _headline("LIBERO-PRO, other words", "libero_goal_lan"),
        _headline("LIBERO-PRO, never demonstrated", "libero_goal_task"),
        _headline("LIBERO-PRO, other looks", "libero_goal_object"),
    ]
    there = [row for row in rows if row is not None]
    if not there:
        return "Nothing is measured of the headline figures on the present code; `make figures` measures it."
    heads = ["From camera images", "Demonstrations a task", "Success", "95 % interval", "Episodes"]
    return table([*heads, "Learning, s"], there)


def _headline(what: str, name: str, seconds: str = "") -> list[Any] | None:
    """A result's row; `seconds` names how long it learned, where that is not another row's."""
    result = quoted(name)
    if result is None:
        return None
    learned_s = result[seconds] if seconds else None
    return [what, result["demonstrations"], *_rate(result), _in_s(learned_s, result)]


def _taught(what: str) -> list[Any] | None:
    result = quoted("teach")
    if result is None:
        return None
    return [what, 1, *_rate(result["demonstrations"]["1"]), _in_s(result["teach_s"], result)]


def _rate(run: dict[str, Any]) -> list[Any]:
    return [percent(run), interval(run), run["n"]]


def _in_s(seconds: float | None, result: Quoted) -> str:
    """The last cell of a row, which also holds the marks."""
    return f"{'-' if seconds is None else f'{seconds:.0f}'} {result.marks}"


def _demo(result: Quoted) -> str:
    seconds = {
        "mining and training": result["train_s"],
        "with recording and evaluating": result["total_s"],
    }
    told = ", ".join(f"{what} {s:.0f} s" for what, s in seconds.items() if s is not None)
    overall = grid({"all ten tasks": result}, STEPS)
    per_task = grid(_of_each(result), SUCCESS, "Task")
    return f"{overall}\n\n{told.capitalize()}.\n\n{per_task}{looked_at(result)}"


def _execution(result: Quoted) -> str:
    note = f"The demonstrations take {result['expert_steps']} steps on average. {STRAIGHT}"
    return f"{grid(result['runs'], STEPS)}\n\n{note}\n\n{_per_task(result['runs'])}"


def _with_tasks(result: Quoted) -> str:
    return f"{grid(result['runs'], STEPS)}\n\n{_per_task(result['runs'])}"


def _conditioning(result: Quoted) -> str:
    return f"{_with_tasks(result)}\n\nThe flow model gives the ways of pushes, drawers and knobs alone."


def _selection(result: Quoted) -> str:
    ((name, run),) = result["runs"].items()
    per_task = _of_each(run)
    rows = {text: per_task[task] for task, text in result["instructions"].items()}
    told = f"{grid(result['runs'], STEPS)}\n\n{NOTES[name]}\n\n{grid(rows, SUCCESS, 'Instruction')}"
    return told + looked_at(result)


def _anywhere(result: Quoted) -> str:
    """Success, what the first looks at such scenes tell, and which scenes were left out."""
    looks = result["first_looks"]
    columns: Columns = {
        "Poses": "poses",
        "Not found": "unknown",
        "Mean, mm": "position_mm_mean",
        "95th percentile, mm": "position_mm_p95",
        "Mean yaw, degrees": "yaw_deg_mean",
        "Yaw off by more than 90": "turned_round",
    }
    rows = {"all that are known": looks["poses"], "those that the task needs": looks["poses_needed"]}
    false, sure, layouts = looks["false_finds"], looks["confident_and_right"], looks["layouts"]
    left_out = layouts["hidden"] + layouts["unsolved"]
    told = (
        f"First looks at {looks['looks']} of these scenes, against the simulator's poses; yaw of those "
        f"objects that show one. Of two alike that the task does not name, the nearer one counts. With an "
        f"object taken away, it was reported in {percent(false)} of "
        f"{false['n']} looks ({interval(false)}). Of {sure['n']} estimates with a confidence above 0.95, "
        f"{percent(sure)} ({interval(sure)}) are within 10 mm and 10 degrees. For these scenes "
        f"{layouts['drawn']} layouts were drawn, and {left_out} ({share(left_out / layouts['drawn'])}) not "
        f"used: {layouts['hidden']} do not show one of the two objects well enough, and the expert does not "
        f"solve {layouts['unsolved']}. One that is found turned round by half weighs much in a mean yaw."
    )
    return f"{_selection(result)}\n\n{grid(rows, columns, 'Objects')}\n\n{told}"


def _per_task(runs: dict[str, Any]) -> str:
    tasks = next(iter(runs.values()))["per_task"]
    rows = [[task, *(f"{100 * run['per_task'][task]:.0f} %" for run in runs.values())] for task in tasks]
    return table(["Task", *(name.replace("_", " ") for name in runs)], rows)


def _of_each(run: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Success of each task, of which there were equally many episodes."""
    n = run["n"] // len(run["per_task"])
    return {task: rate(round(success * n), n) for task, success in run["per_task"].items()}


def drop_what_is_not_current() -> list[Path]:
    """Delete results that are stale or cannot be taken again; returns them."""
    files = sorted((ROOT / "benchmarks/results").glob("*.json"))
    known = {path: FIGURES.get(path.stem) for path in files}
    dropped = [
        path
        for path, one in known.items()
        if origin(path.stem, one and one.paths, expected_command=one and one.command).problem
    ]
    for path in dropped:
        path.unlink()
    return dropped


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--current", action="store_true", help="delete results that are not current")
    if parser.parse_args().current:
        for path in drop_what_is_not_current():
            print(f"deleted {path.name}")
    write_pages()
