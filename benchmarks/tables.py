"""Writes ``docs/results.md`` from the JSON files under ``benchmarks/results``; measures nothing itself."""

from pathlib import Path
from typing import Any

from benchmarks.libero.tables import libero_parts
from benchmarks.markdown import part, rates, table
from benchmarks.memory_tables import memory_parts
from benchmarks.perception_tables import perception_parts

INTRODUCTION = """# Results on the tabletop

Made by `python -m benchmarks.tables` from `benchmarks/results`; each file there says on what commit and
machine it was measured. Ten demonstrations a task; seeds from 1000 on. They were measured once before, at an
earlier commit; in between the rack's shape was mended, judged on scenes of other seeds. Since then control
and perception have changed. The ten tasks share their scenes seed by seed. Rates come with 95 % Wilson
intervals."""
PARTS = "Instructions of which only the parts were demonstrated, from pixels"
NOTES = {
    "compound": "The ten tasks were demonstrated, these five never were: each is carried out by memories of "
    "its parts, one after another, with 300 steps for each part.",
    "two_bowls": "No demonstration shows two bowls; which one is meant is told from where the objects are.",
}
PAGE = Path(__file__).parent.parent / "docs" / "results.md"


def write_page() -> None:
    """Write the page; a table whose JSON is missing says so."""
    parts = [
        INTRODUCTION,
        part("How key poses are followed, from pixels", "execution", _execution, "figures"),
        part("Object poses from the simulator (oracle)", "oracle", _oracle, "figures"),
        part("What the flow model is told, from pixels", "conditioning", _conditioning, "figures"),
        part(PARTS, "compound", _selection, "selection compound"),
        part("Which of two bowls is meant, from pixels", "two_bowls", _selection, "selection two_bowls"),
        part("Error of the object poses on unseen scenes", "perception", _perception, "figures"),
        *libero_parts(),
        *perception_parts(),
        *memory_parts(),
    ]
    PAGE.write_text("\n\n".join(parts) + "\n")


def _execution(result: dict[str, Any]) -> str:
    note = f"The demonstrations take {result['expert_steps']} steps on average; mining and training took "
    return f"{rates(result['runs'])}\n\n{note}{result['train_s']:.0f} s.\n\n{_per_task(result['runs'])}"


def _oracle(result: dict[str, Any]) -> str:
    runs = {"oracle": result["oracle"]}
    return f"{rates(runs)}\n\n{_per_task(runs)}"


def _conditioning(result: dict[str, Any]) -> str:
    return rates({name: result[name] for name in ("equivariant", "paper")})


def _selection(result: dict[str, Any]) -> str:
    ((name, run),) = result["runs"].items()
    rows = [[text, f"{100 * run['per_task'][task]:.0f} %"] for task, text in result["instructions"].items()]
    note = f"{NOTES[name]} Seeds from {result['seed']} on."
    return f"{rates(result['runs'])}\n\n{note}\n\n{table(['Instruction', 'Success'], rows)}"


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
    return f"{table(heads, rows)}\n\n{note}"


def _per_task(runs: dict[str, Any]) -> str:
    tasks = next(iter(runs.values()))["per_task"]
    rows = [[task, *(f"{100 * run['per_task'][task]:.0f} %" for run in runs.values())] for task in tasks]
    return table(["Task", *(name.replace("_", " ") for name in runs)], rows)


if __name__ == "__main__":
    write_page()
