"""LIBERO's part of ``docs/results.md``: the paper's tables with our figures beside its own."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from benchmarks.markdown import RESULTS, interval, origin, part, percent, rates, table

INTRODUCTION = """# Results on LIBERO-GOAL

From scripted demonstrations of seeded scenes, with LIBERO's two RGB cameras, the robot's state and the
instruction alone. Evaluation: the benchmark's own initial states, which no demonstration starts from, at most
300 steps, images of 360 pixels as lerobot-eval renders them. "Paper" is what the paper reports of itself."""
# As the paper's table quotes them: parameters, chunk length, success in percent, frequency in Hz.
PUBLISHED = (
    ("Diffusion Policy", "260 M", 8, 68.3, 14.2),
    ("TraceVLA", "7 B", 1, 75.1, 2.2),
    ("SpatialVLA", "4 B", 4, 78.6, 6.7),
    ("OpenVLA", "7 B", 1, 79.2, 4.9),
    ("WorldVLA", "7 B", 25, 83.4, 2.4),
    ("Octo-Base", "200 M", 4, 84.6, 54.7),
    ("OpenSPM, paper", "0.24 M", 5, 85.6, 1033.3),
)
PAPER_EXECUTION = {"closed_loop_trc": 85.6, "closed_loop": 29.8, "open_loop": 3.0}
PAPER_GUESS = 23.8
# Position in millimetres and orientation in degrees, of the paper's filter against its own visual reference.
PAPER_POSES = (
    (4.3, 2.0), (4.1, 0.9), (5.0, 1.2), (14.7, 6.4), (5.5, 2.5), (5.7, 1.6), (4.6, 1.1), (5.1, 1.3),
    (4.0, 1.0), (5.0, 1.8),
)  # fmt: skip
FAR_OFF_MM = 10.0
CONSTRAINED = ("push", "open", "turn", "drawer")


def libero_parts() -> list[str]:
    """All sections; one whose JSON is missing says so."""
    return [
        INTRODUCTION,
        part("Success from pixels", "libero_goal", _main, "libero.run"),
        part("Failures", "libero_goal", _failures, "libero.run"),
        part("How key poses are followed", "libero_ablations", _execution, "libero.ablations"),
        part("Where key poses come from", "libero_ablations", _memory, "libero.ablations"),
        part("Object poses from the simulator (oracle)", "libero_ablations", _oracle, "libero.ablations"),
        part("Error of the object poses", "libero_accuracy", _accuracy, "libero.run"),
        _several("Few demonstrations", "libero_few_shot_*.json", _few_shot, "libero.few_shot"),
        _several("A new task by memory alone", "libero_new_task_*.json", _new_tasks, "libero.new_task"),
        part("Loss over epochs", "libero_losses", _losses, "libero.losses"),
        part("The harness against lerobot-eval", "libero_equality", _equality, "libero.equality"),
    ]


def _several(title: str, pattern: str, render: Callable[[list[dict[str, Any]]], str], script: str) -> str:
    """A section from several files."""
    found = [json.loads(path.read_text()) for path in sorted(RESULTS.glob(pattern))]
    if not found:
        return f"## {title}\n\nNot measured: no `{pattern}`; run `python -m benchmarks.{script}`."
    return f"## {title}\n\n{render(found)}\n\n{origin(found[0])}"


def _main(result: dict[str, Any]) -> str:
    latency = RESULTS / "libero_latency.json"
    timing = json.loads(latency.read_text()) if latency.exists() else None
    ours: list[Any] = [f"**OpenSPM, {result['demonstrations']} demonstrations a task**"]
    if timing:
        ours += [f"{timing['parameters'] / 1e6:.2f} M", timing["chunk_size"]]
    else:
        ours += [None, None]
    ours += [f"**{percent(result)}**", timing and timing["equivalent_hz"], timing and timing["decisions_hz"]]
    rows = [[name, size, length, f"{rate} %", hz, None] for name, size, length, rate, hz in PUBLISHED]
    heads = [
        "",
        "Parameters",
        "Chunk",
        "Success",
        "Actions per second, 1000 H / t",
        "Decisions per second, 1000 / t",
    ]
    tasks = [
        [task.replace("_", " "), percent(row), interval(row), row["n"], row["mean_steps"]]
        for task, row in result["per_task"].items()
    ]
    tasks.append(["**all**", percent(result), interval(result), result["n"], result["mean_steps"]])
    text = f"{table(heads, [*rows, ours])}\n\nThe rows above ours are quoted from the paper."
    if timing:
        chunk, first = timing["chunk_ms"], timing["first_action_ms"]
        text += (
            f" A chunk takes t = {chunk['median']} ms (99th percentile {chunk['p99']}, n = {chunk['n']}), an "
            f"episode's first action with finding the objects in the images {first['median']} ms "
            f"({first['p99']}, n = {first['n']}), on one thread."
        )
    else:
        text += " A chunk's time: not measured; run `python -m benchmarks.libero.latency`."
    seconds = result["mine_and_train_s"]
    taken = "was interrupted" if seconds is None else f"took {seconds} s"
    told = f"Mining and training {taken}. {result['note']}"
    per_task = table(["Task", "Success", "95 % interval", "Episodes", "Mean steps of successes"], tasks)
    return f"{text}\n\n{per_task}\n\n{told}"


def _failures(result: dict[str, Any]) -> str:
    """The paper's three categories, told apart by rule."""
    counts = {"perception": 0, "small tolerances": 0, "geometric constraints": 0}
    physical = 0
    for failed in result["failed"]:
        if failed["off_mm"] is None or failed["off_mm"] > FAR_OFF_MM:
            counts["perception"] += 1
            continue
        physical += 1
        constrained = any(word in failed["task"] for word in CONSTRAINED)
        counts["geometric constraints" if constrained else "small tolerances"] += 1
    n = len(result["failed"])
    rows = [[name, count] for name, count in counts.items()]
    listed = "; ".join(
        f"{f['task'].replace('_', ' ')}, state {f['state']}: {f['reason']}, after {f['attempts']} further "
        f"attempts, objects within {f['off_mm']} mm"
        for f in result["failed"]
    )
    share = (
        f"{physical} of {n} failed episodes failed in acting, nearest to what the paper calls physical."
        if n
        else "None failed."
    )
    rule = (
        f"Perception: an object that was touched was not found, or found more than {FAR_OFF_MM:.0f} mm off. "
        "Geometric constraints: of the others, those of tasks that push, open or turn. Else small tolerances."
    )
    return f"{table(['Category', 'Episodes'], rows)}\n\n{rule} {share}" + (f"\n\n{listed}." if n else "")


def _execution(result: dict[str, Any]) -> str:
    runs = result["runs"]
    rows = [
        [
            name.replace("_", " "), percent(runs[name]), interval(runs[name]), runs[name]["n"],
            runs[name]["mean_steps"], f"{paper} %",
        ]
        for name, paper in PAPER_EXECUTION.items()
    ]  # fmt: skip
    return table(["", "Success", "95 % interval", "Episodes", "Mean steps of successes", "Paper"], rows)


def _memory(result: dict[str, Any]) -> str:
    runs = result["runs"]
    sources = {
        "memory, poses from pixels": ("closed_loop_trc", "85.6 %"),
        "memory, the simulator's poses": ("oracle", None),
        "guess, the simulator's poses": ("geometric_guess", f"{PAPER_GUESS} %"),
    }
    rows = [
        [told, percent(runs[name]), interval(runs[name]), runs[name]["n"], paper]
        for told, (name, paper) in sources.items()
    ]
    note = (
        "The guess, which knows no demonstration: grasp the centroid from above, release above the landmark. "
        "It gets the simulator's poses and sizes of the objects. The paper asks a multimodal model instead; "
        "that is not built yet."
    )
    return f"{table(['Key poses from', 'Success', '95 % interval', 'Episodes', 'Paper'], rows)}\n\n{note}"


def _oracle(result: dict[str, Any]) -> str:
    runs = result["runs"]
    return rates({"from pixels": runs["closed_loop_trc"], "oracle": runs["oracle"]})


def _accuracy(result: dict[str, Any]) -> str:
    objects = [
        [name, row["n"], row["position_mm_mean"], row["position_mm_p95"], row["yaw_deg_mean"]]
        for name, row in result["objects"].items()
    ]
    tasks = [
        [
            task.replace("_", " "),
            row["n"],
            row["position_mm_mean"],
            row["position_mm_p95"],
            row["yaw_deg_mean"],
            *paper,
        ]
        for (task, row), paper in zip(result["tasks"].items(), PAPER_POSES, strict=True)
    ]
    heads = ["n", "Mean, mm", "95th percentile, mm", "Yaw, degrees"]
    note = (
        "Against the simulator, at the start of evaluated episodes, of the objects that a task touches. A "
        "learned object's frame stands anywhere on it: one rigid offset per object was fitted on the "
        "demonstrations. Objects known by patches are taken to stand as demonstrated: their yaw is not "
        "measured, and the error in it is how far they turned. The paper's columns compare its filter with "
        "another estimator, not with the truth."
    )
    per_task = table(["Task", *heads, "Paper, mm", "Paper, degrees"], tasks)
    return f"{table(['Object', *heads], objects)}\n\n{per_task}\n\n{note}"


def _few_shot(results: list[dict[str, Any]]) -> str:
    full = RESULTS / "libero_goal.json"
    found = [*results, json.loads(full.read_text())] if full.exists() else results
    rows = [
        [
            r["demonstrations"],
            percent(r),
            interval(r),
            r["n"],
            r["mean_steps"],
            r["mine_and_train_s"],
            r["commit"],
        ]
        for r in sorted(found, key=lambda r: r["demonstrations"])
    ]
    heads = [
        "Demonstrations a task",
        "Success",
        "95 % interval",
        "Episodes",
        "Mean steps",
        "Mining and training, s",
        "Commit",
    ]
    return table(heads, rows)


def _new_tasks(results: list[dict[str, Any]]) -> str:
    rows = [
        [
            r["task"].replace("_", " "),
            r["demonstrations"],
            percent(r),
            interval(r),
            r["n"],
            r["teach_s"],
            r["commit"],
        ]
        for r in results
    ]
    mean = sum(r["success"] for r in results) / len(results)
    heads = [
        "Task left out of training",
        "Demonstrations",
        "Success",
        "95 % interval",
        "Episodes",
        "Teaching, s",
        "Commit",
    ]
    note = f"Mean over these {len(results)} tasks: {100 * mean:.1f} %. No gradient step after teaching."
    return f"{table(heads, rows)}\n\n{note}"


def _losses(result: dict[str, Any]) -> str:
    last = (
        f"At the end: training {result['training'][-1]}, validation {result['validation'][-1]}. Both over "
        "all frames as they were recorded, with the same noise for every checkpoint; training itself also "
        "draws perturbed copies, and rare phases more often."
    )
    return f"![Training and validation loss](images/{result['plot']})\n\n{last}"


def _equality(result: dict[str, Any]) -> str:
    return (
        f"{result['equal']} of {result['episodes']} episodes by LeRobot's own rollout and by the harness, "
        "which renders only when the policy looks, took the same actions bit by bit "
        f"({result['actions']} actions; largest difference {result['largest_difference']})."
    )
