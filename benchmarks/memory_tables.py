"""The part of ``docs/results.md`` on memory and language: instructions, key poses, teaching, large banks."""

from __future__ import annotations

from typing import Any

from benchmarks.markdown import part, percent, table

from lerobot_openspm.cli.pipeline import rate

INTRODUCTION = """# Results of memory and language

The paraphrases and the instructions to be refused were written without sight of the grammar. Those held out
were looked at once, after it was done; they are the third such set. Of the first (150, half of one writer's
300) 94.0 % were read at first sight and the right entry came first for 93.0 %; of the second (150, another
writer) 84.0 % and 92.0 %. Both were developed on afterwards, and are among those called dev. Of the third
set's 150 sentences 7 stand in the earlier ones too and were left out. Seeds of evaluation were used for
nothing else."""


def memory_parts() -> list[str]:
    """All sections; one whose JSON is missing says so."""
    return [
        INTRODUCTION,
        part("Instructions in free wording", "language", _language, "followed language"),
        part("Key poses on the tabletop", "keyposes_openspm_tabletop", _key_poses, "followed keyposes"),
        part("Key poses on LIBERO-GOAL", "keyposes_libero", _key_poses, "followed keyposes"),
        part("Tasks taught by memory alone, from pixels", "teach", _teach, "followed teach"),
        part("Large memories", "memory", _memory, "followed memory"),
    ]


def _language(result: dict[str, Any]) -> str:
    rows = [["the wordings of LIBERO's 130 tasks", *_share(result["libero_parsed"], result["n_libero"])]]
    for split, one in result["splits"].items():
        rows += [
            [f"paraphrases read, {split}", *_share(one["paraphrases_parsed"], one["n"])],
            [f"right entry first, {split}", *_share(one["retrieved_first"], one["n_retrieved"])],
            [f"others refused, {split}", *_share(one["out_of_domain_refused"], one["n_out_of_domain"])],
        ]
    note = (
        "Entries are those of the tabletop's ten tasks and of the forty of libero_spatial, libero_object, "
        "libero_goal and libero_10; paraphrases of other tasks have none among them."
    )
    return f"{table(['', 'Rate', '95 % interval', 'n'], rows)}\n\n{note}"


def _share(share: float, n: int) -> list[Any]:
    one = rate(round(share * n), n)
    low, high = one["interval"]
    return [percent(one), f"{100 * low:.1f} to {100 * high:.1f} %", n]


def _key_poses(result: dict[str, Any]) -> str:
    heads = ["Phase", "F1 within 3 frames", "Mean, mm", "n"]
    rows = [
        [name, one["f1_3_frames"], one["position_mm_mean"], one["n"]]
        for name, one in (*result["phases"].items(), ("all", result))
    ]
    note = (
        f"{result['episodes']} episodes of an operator who is {result['operator']}: tremor, pauses, "
        f"overshoot, fingers closed twice. n counts true events; seeds from {result['seed']} on."
    )
    return f"{table(heads, rows)}\n\n{note}"


def _teach(result: dict[str, Any]) -> str:
    found = result["demonstrations"]
    rows = [[task.replace("_", " "), *(f"{100 * x:.0f} %" for x in ones)] for task, ones in _tasks(result)]
    totals = [f"{100 * result[name]:.1f} %" for name in ("success_1_demo", "success_3_demos")]
    note = (
        f"Each task is taught to a policy that was trained on the nine others; {result['n']} episodes for "
        f"each number of demonstrations ({', '.join(found)}), seeds from {result['seed']} on. The longest "
        f"lesson took {result['teach_s']:.0f} s."
    )
    heads = ["Task", "1 demonstration", "3 demonstrations"]
    return f"{table(heads, [*rows, ['mean', *totals]])}\n\n{note}"


def _tasks(result: dict[str, Any]) -> list[tuple[str, list[float]]]:
    return [(task, list(ones.values())) for task, ones in result["tasks"].items()]


def _memory(result: dict[str, Any]) -> str:
    heads = ["Keys", "Median, ms", "99th percentile, ms", "... of the thread's own work", "Recall"]
    rows = [
        [name, one["query_ms_p50"], one["query_ms_p99"], one["query_cpu_ms_p99"], one["recall"]]
        for name, one in ((name, result[name]) for name in ("tasks", "uniform"))
    ]
    note = (
        f"{result['entries']:,} different keys of 64 numbers, {result['queries']} queries one by one. Of "
        f"10,000 keys the exact search takes {result['exact_10k_ms_p50']} ms (median). A memory of "
        f"{result['loaded']:,} entries loads in {result['load_s_100k']} s (median of 3)."
    )
    return f"{table(heads, rows)}\n\n{note}"
