"""Writes ``docs/results.md`` from the JSON files under ``benchmarks/results``; measures nothing itself."""

import json
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
INTRODUCTION = """# Results on the tabletop

Made by `python -m benchmarks.tables` from `benchmarks/results`; each file there says on what commit and
machine it was measured. Ten demonstrations a task; seeds from 1000 on. They were measured once before, at an
earlier commit; in between the rack's shape was mended, judged on scenes of other seeds. The ten tasks share
their scenes seed by seed. Rates come with 95 % Wilson intervals."""
LIBERO = """# Results on LIBERO-GOAL

From scripted demonstrations of seeded scenes, with LIBERO's two RGB cameras, the robot's state and the
instruction alone."""
PAGE = Path(__file__).parent.parent / "docs" / "results.md"


def write_page() -> None:
    """Write the page; a table whose JSON is missing says so."""
    parts = [
        INTRODUCTION,
        _part("How key poses are followed, from pixels", "execution", _execution),
        _part("Object poses from the simulator (oracle)", "oracle", _oracle),
        _part("What the flow model is told, from pixels", "conditioning", _conditioning),
        _part("Error of the object poses on unseen scenes", "perception", _perception),
        LIBERO,
        _part("Success from pixels, 50 initial states a task", "libero_goal", _libero, "libero.run"),
    ]
    PAGE.write_text("\n\n".join(parts) + "\n")


def _part(title: str, name: str, table: Any, script: str = "figures") -> str:
    path = RESULTS / f"{name}.json"
    if not path.exists():
        return f"## {title}\n\nNot measured: `{path.name}` is missing; run `python -m benchmarks.{script}`."
    result = json.loads(path.read_text())
    note = (
        f"Commit `{result['commit']}`, {result['machine']['cores']} cores ({result['machine']['processor']})."
    )
    if provenance := result.get("provenance"):
        note = f"{note} {provenance}"
    return f"## {title}\n\n{table(result)}\n\n{note}"


def _execution(result: dict[str, Any]) -> str:
    note = f"The demonstrations take {result['expert_steps']} steps on average; mining and training took "
    return f"{_rates(result['runs'])}\n\n{note}{result['train_s']:.0f} s.\n\n{_per_task(result['runs'])}"


def _oracle(result: dict[str, Any]) -> str:
    runs = {"oracle": result["oracle"]}
    return f"{_rates(runs)}\n\n{_per_task(runs)}"


def _conditioning(result: dict[str, Any]) -> str:
    return _rates({name: result[name] for name in ("equivariant", "paper")})


def _libero(result: dict[str, Any]) -> str:
    demonstrations = " to ".join(str(n) for n in result["demonstrations"])
    rows = [
        [task.replace("_", " "), f"{100 * row['success']:.0f} %", row["n"], row["mean_steps"]]
        for task, row in result["per_task"].items()
    ]
    overall = _rates({f"{demonstrations} demonstrations a task": result})
    table = _table(["Task", "Success", "Episodes", "Mean steps of successes"], rows)
    return f"{overall}\n\n{table}\n\n{result['note']}"


def _perception(result: dict[str, Any]) -> str:
    rows = [
        [
            name,
            row["n"],
            row["not_found"],
            row["position_mm_mean"],
            row["position_mm_p95"],
            "round" if row["yaw_deg_mean"] is None else row["yaw_deg_mean"],
        ]
        for name, row in result["objects"].items()
    ]
    note = (
        "A learned object's frame stands anywhere on it: one rigid offset per object was fitted on the "
        "demonstrations, and the errors are what remains."
    )
    heads = ["Object", "Scenes", "Not found", "Mean, mm", "95th percentile, mm", "Yaw, degrees"]
    return f"{_table(heads, rows)}\n\n{note}"


def _rates(runs: dict[str, Any]) -> str:
    rows = [
        [
            name.replace("_", " "),
            f"{100 * run['success']:.1f} %",
            f"{100 * run['interval'][0]:.1f} to {100 * run['interval'][1]:.1f} %",
            run["n"],
            run["mean_steps"],
        ]
        for name, run in runs.items()
    ]
    return _table(["", "Success", "95 % interval", "Episodes", "Mean steps of successes"], rows)


def _per_task(runs: dict[str, Any]) -> str:
    tasks = next(iter(runs.values()))["per_task"]
    rows = [[task, *(f"{100 * run['per_task'][task]:.0f} %" for run in runs.values())] for task in tasks]
    return _table(["Task", *(name.replace("_", " ") for name in runs)], rows)


def _table(heads: list[str], rows: list[list[Any]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


if __name__ == "__main__":
    write_page()
