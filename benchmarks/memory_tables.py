"""The part of ``docs/results.md`` on memory and language: language, key poses, teaching, large memories."""

from __future__ import annotations

from typing import Any

from benchmarks.markdown import Columns, Quoted, chapter, grid, interval, percent, section, table
from lerobot_openspm.cli.pipeline import rate

INTRODUCTION = """# Memory and language

The paraphrases and the instructions to be refused were written without sight of the code that reads them.
Those called dev were developed on, those held out were not."""


def memory_sections() -> list[str]:
    """The chapter, of what was measured."""
    return chapter(
        INTRODUCTION,
        [
            section("Instructions in free wording", "language", _language),
            section("Key poses on the tabletop", "keyposes_tabletop", _key_poses),
            section("Key poses on LIBERO-GOAL", "keyposes_libero", _key_poses),
            section("Tasks taught by memory alone, from pixels", "teach", _teach),
            section("Large memories", "memory", _memory),
        ],
    )


def _language(result: Quoted) -> str:
    rows = [
        ["the entry that is meant acts", *_share(result["acted_entry_right"], result["n_acted"])],
        ["any wording is learned", *_share(result["any_wording_learned"], result["n_wordings"])],
        ["the wordings of LIBERO's 130 tasks are read", *_share(result["libero_parsed"], result["n_libero"])],
    ]
    for split, one in result["splits"].items():
        name = split.replace("_", " ")
        rows += [
            [f"paraphrases read, {name}", *_share(one["paraphrases_parsed"], one["n"])],
            [f"right entry first, {name}", *_share(one["retrieved_first"], one["n_retrieved"])],
            [f"others refused, {name}", *_share(one["out_of_domain_refused"], one["n_out_of_domain"])],
        ]
    note = (
        "Any wording: everyday instructions, written with the grammar in sight, more than half of which it "
        "cannot read, each taught from one drawn demonstration and found by its own words and by a light "
        "rewording, but not by another's. Acting: over these, the known instructions and the paraphrases, "
        f"of which {result['n_refused']} were refused. "
        "Reading: entries are those of the tabletop's ten tasks and of the forty of libero_spatial, "
        "libero_object, libero_goal and libero_10; paraphrases of other tasks have none among them."
    )
    return f"{table(['', 'Rate', '95 % interval', 'n'], rows)}\n\n{note}"


def _share(share: float, n: int) -> list[Any]:
    one = rate(round(share * n), n)
    return [percent(one), interval(one), n]


def _key_poses(result: Quoted) -> str:
    columns: Columns = {"F1 within 3 frames": "f1_3_frames", "Mean, mm": "position_mm_mean", "n": "n"}
    table = grid({**result["phases"], "all": result}, columns, "Phase")
    note = (
        f"{result['episodes']} episodes of an unsteady operator: tremor, pauses, overshoot, fingers closed "
        "twice. n counts true events."
    )
    return f"{table}\n\n{note}"


def _teach(result: Quoted) -> str:
    found = result["demonstrations"]
    tasks = next(iter(found.values()))["per_task"]
    rows = [
        [task.replace("_", " "), *(f"{100 * one['per_task'][task]:.0f} %" for one in found.values())]
        for task in tasks
    ]
    totals = [percent(one) for one in found.values()]
    note = (
        f"Each task is taught to a policy that was trained on the nine others; {result['n']} episodes for "
        f"each number of demonstrations ({', '.join(found)}). The longest lesson took "
        f"{result['teach_s']:.0f} s."
    )
    heads = ["Task", "1 demonstration", "3 demonstrations"]
    return f"{table(heads, [*rows, ['mean', *totals]])}\n\n{note}"


def _memory(result: Quoted) -> str:
    columns: Columns = {
        "Median, ms": "query_ms_p50",
        "99th percentile, ms": "query_ms_p99",
        "... of the thread's own work": "query_cpu_ms_p99",
        "Recall": "recall",
    }
    keys = grid({name: result[name] for name in ("tasks", "uniform")}, columns, "Keys")
    note = (
        f"{result['entries']:,} different keys of 64 numbers, {result['n']} queries one by one. *Tasks* are "
        "keys made up of things, attributes, relations and operations, asked for with some left out and "
        "relations changed; *uniform* are random unit vectors, the worst there is. Recall is how often the "
        f"exactly nearest key is found. Of {result['exact_entries']:,} keys the exact search takes "
        f"{result['exact_ms_p50']} ms (median). A memory of {result['loaded_entries']:,} entries loads in "
        f"{result['load_s']} s (median of 3)."
    )
    return f"{keys}\n\n{note}"
