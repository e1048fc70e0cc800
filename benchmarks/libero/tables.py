"""LIBERO's part of ``docs/results.md``: the paper's tables with our figures beside its own."""

from __future__ import annotations

from benchmarks.figures import FIGURES, OTHER_SUITES, SUITES
from benchmarks.libero.failures import FAR_OFF_MM as FAR_OFF
from benchmarks.libero.failures import KINDS
from benchmarks.libero.places_tables import places_sections
from benchmarks.markdown import (
    STEPS,
    STRAIGHT,
    SUCCESS,
    Columns,
    Quoted,
    chapter,
    grid,
    looked_at,
    percent,
    quoted,
    section,
    share,
    table,
)

INTRODUCTION = """# On LIBERO-GOAL

From scripted demonstrations of seeded scenes, with LIBERO's two RGB cameras, the robot's state and the
instruction alone. Evaluation: the benchmark's own initial states, which no demonstration starts from, at most
300 steps, images of 360 pixels as lerobot-eval renders them. "Paper" is what the paper reports of itself."""
OTHERS = """# On LIBERO's other suites

The same with at most 280 steps in libero_spatial and libero_object, and at most 520 in libero_10. What is
called the same looks otherwise in each of the nine scenes of libero_10, and cameras and robot stand elsewhere
in some: each scene is learned by itself, and one policy is joined of them."""
DEMONSTRATIONS = """# LIBERO's demonstrations

Of all scenes that were tried until ten demonstrations of each task were kept. One in which the expert does
not reach the goal within the steps that LIBERO allows is not kept, and another scene is drawn."""
HARNESS = """# The harness against lerobot-eval

Episodes by LeRobot's own rollout and by the harness, which renders only when the policy looks, from the
first initial state of each task. Equal: both took the same actions bit by bit."""
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
# Millimetres by task, of the paper's filter against its own visual reference.
PAPER_MM = (4.3, 4.1, 5.0, 14.7, 5.5, 5.7, 4.6, 5.1, 4.0, 5.0)
FAR_OFF_MM = 10.0
CONSTRAINED = ("push", "open", "turn", "drawer")
CONTACTS: Columns = {
    "Touched others": lambda row: share(row["touched"]),
    "Moved others": lambda row: share(row["moved"]),
}
LEARNED: Columns = {**SUCCESS, "Mean steps": "mean_steps", "Mining and training, s": "mine_and_train_s"}
TOUCHED = (
    "Others: objects that neither the instruction nor the goal names. Shares of the episodes, failed ones "
    "too, in which the arm, the hand or what it carried or pushed touched one, and in which one was moved by "
    "more than 1 cm."
)

SEEN_BEFORE = (
    "[libero.md](libero.md) says which of these episodes were run while the policy was developed, and what "
    "was made of them."
)
SORTED = (
    "Failed episodes by a rule; the first that fits counts. Words: the instruction was not understood. "
    "Perception: an object was not found or was lost, a camera was not believed, or a pose was more than "
    f"{FAR_OFF:.0f} mm off at the first look. Reach: no remembered motion passed the checks of reach and "
    "clearance. Grasp: the hand did not keep hold of all that it was to take hold of. Placing: the rest, "
    "gripped or pushed but without reaching the goal. Collisions are told by a look alone: objects that are "
    "not of the task are touched in episodes that succeed too."
)


def libero_sections() -> list[str]:
    """The chapters, of what was measured."""
    few = sorted(
        (n for n in FIGURES if n.startswith("libero_few_shot_")), key=lambda n: int(n.rsplit("_", 1)[1])
    )
    new = [name for name in FIGURES if name.startswith("libero_new_task_")]
    on_goal = chapter(
        INTRODUCTION,
        [
            section("Success from pixels", "libero_goal", _main),
            section("Time of a decision", "libero_latency", _latency),
            section("Failures", "libero_goal", _failures),
            section("Objects exchanged (LIBERO-PRO)", "libero_goal_swap", _variant),
            section("Instructions in other words (LIBERO-PRO)", "libero_goal_lan", _variant),
            section("Tasks that were never demonstrated (LIBERO-PRO)", "libero_goal_task", _variant),
            section("Objects that look otherwise (LIBERO-PRO)", "libero_goal_object", _variant),
            section("How key poses are followed", "libero_ablations", _execution),
            section("Where key poses come from", "libero_ablations", _memory),
            section("Error of the object poses", "libero_accuracy", _accuracy),
            *places_sections(),
            section("Few demonstrations", [*few, "libero_goal"], _few_shot),
            section("A new task by memory alone", new, _new_tasks),
            section("Loss over epochs", "libero_losses", _losses),
        ],
    )
    others = [section(f"On {suite}", suite, _suite) for suite in OTHER_SUITES]
    joined = ["libero_all", *SUITES] if quoted("libero_all") else []
    on_others = [
        *others,
        section("One policy for all four", joined, _all_suites),
        section("From three demonstrations a task", [f"{one}_few_shot_3" for one in OTHER_SUITES], _by_suite),
    ]
    equal = section("The four suites", [f"{suite}_equality" for suite in SUITES], _equality)
    shown = section("The experts", "libero_experts", _experts)
    return [
        *on_goal,
        *chapter(OTHERS, on_others),
        *chapter(DEMONSTRATIONS, [shown]),
        *chapter(HARNESS, [equal]),
    ]


def _variant(result: Quoted) -> str:
    per_task = grid({"all ten tasks": result, **result["per_task"]}, {**STEPS, **CONTACTS})
    return f"{per_task}\n\n{TOUCHED} {SEEN_BEFORE}\n\n{_sorted(result)}{looked_at(result)}"


def _suite(result: Quoted) -> str:
    taken = f"{_taken(result)} {SEEN_BEFORE}"
    return f"{_per_task(result)}\n\n{taken}\n\n{_sorted(result)}{looked_at(result)}"


def _all_suites(results: list[Quoted]) -> str:
    """The joint policy, suite by suite beside the policy of that suite alone where that was measured."""
    result, *others = results
    alone = {other.name: other["success"] for other in others}
    rows = {
        suite: {**row, "alone": alone.get(suite), "all": row["success"]}
        for suite, row in result["per_suite"].items()
    }
    columns: Columns = {
        **STEPS,
        "Policy of this suite alone": lambda row: share(row["alone"]),
        "Difference, points": lambda row: row["alone"] and f"{100 * (row['all'] - row['alone']):+.1f}",
    }
    failures = {suite: row["failures"] for suite, row in result["per_suite"].items()}
    kinds: Columns = {kind: kind for kind in KINDS}
    by_kind = f"{grid(failures, kinds, 'Failed by')}\n\n{SORTED}{looked_at(result)}"
    return f"{grid(rows, columns, 'Suite')}\n\n{_taken(result)} {SEEN_BEFORE}\n\n{by_kind}"


def _per_task(result: Quoted) -> str:
    rows = {**result["per_task"], "**all**": result}
    return f"{grid(rows, {**STEPS, **CONTACTS}, 'Task')}\n\n{TOUCHED}"


def _taken(result: Quoted) -> str:
    """How long and in how much memory it learned from how many demonstrations, and what came of it."""
    seconds, peak = result["mine_and_train_s"], result["peak_mb"]
    taken = "was interrupted" if seconds is None else f"took {seconds:.0f} s ({seconds / 60:.0f} min)"
    memory = "" if peak is None else f", the largest process {peak} MB of memory"
    return (
        f"Mining and training on {result['demonstrations']} demonstrations a task {taken}{memory}. The "
        f"checkpoint holds {result['entries']} entries and {result['objects']} objects, and has "
        f"{result['checkpoint_mb']} MB."
    )


def _sorted(result: Quoted) -> str:
    """How many episodes failed by what, as `failures` sorts them."""
    counts = result["failures"]
    return f"{table(['Failed by', *counts], [['episodes', *counts.values()]])}\n\n{SORTED}"


def _main(result: Quoted) -> str:
    name = f"**OpenSPM, {result['demonstrations']} demonstrations a task**"
    ours = [name, None, None, f"**{percent(result)}**"]
    rows = [[name, size, length, f"{rate} %"] for name, size, length, rate, _ in PUBLISHED]
    compared = table(["", "Parameters", "Chunk", "Success"], [*rows, ours])
    return (
        f"{compared}\n\nThe rows above ours are quoted from the paper.\n\n{_per_task(result)}\n\n"
        f"{_taken(result)} {SEEN_BEFORE}"
    )


def _latency(result: Quoted) -> str:
    rows = [[name, size, length, None, hz] for name, size, length, _, hz in PUBLISHED]
    chunk, first = result["chunk_ms"], result["first_action_ms"]
    ours = [
        "**OpenSPM**", f"{result['parameters'] / 1e6:.2f} M", result["chunk_size"], f"{chunk['median']:.2f}",
        result["equivalent_hz"],
    ]  # fmt: skip
    heads = ["", "Parameters", "Chunk H", "Chunk t, ms", "Actions per second, 1000 H / t"]
    note = (
        f"The rows above ours are quoted from the paper. A chunk's 99th percentile is {chunk['p99']:.2f} ms "
        f"(n = {chunk['n']}). An episode's first action, for which the objects are found in the images, "
        f"takes {first['median']:.2f} ms ({first['p99']:.2f}, n = {first['n']}). One thread. Most steps ask "
        "for no chunk: the flow model gives the ways of pushes, drawers and knobs."
    )
    return f"{table(heads, [*rows, ours])}\n\n{note}"


def _failures(result: Quoted) -> str:
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
        f"{'attempt' if f['attempts'] == 1 else 'attempts'}, objects within {f['off_mm']} mm"
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
    paper = f"{table(['Category', 'Episodes'], rows)}\n\n{rule} {share}"
    return f"{paper}\n\n{_sorted(result)}{looked_at(result)}" + (f"\n\n{listed}." if n else "")


def _execution(result: Quoted) -> str:
    runs = result["runs"]
    rows = {name: {**runs[name], "paper": f"{paper} %"} for name, paper in PAPER_EXECUTION.items()}
    return f"{grid(rows, {**STEPS, 'Paper': 'paper'})}\n\n{STRAIGHT}"


def _memory(result: Quoted) -> str:
    runs = result["runs"]
    rows = {
        "memory, poses from pixels": {**runs["closed_loop_trc"], "paper": "85.6 %"},
        "memory, the simulator's poses": {**runs["oracle"], "paper": None},
        "guess, the simulator's poses": {**runs["geometric_guess"], "paper": f"{PAPER_GUESS} %"},
    }
    note = (
        "The guess, which knows no demonstration: grasp the centroid from above, release above the landmark. "
        "It gets the simulator's poses and sizes of the objects. The paper asks a multimodal model instead: "
        "see [phase_labels.md](phase_labels.md)."
    )
    return f"{grid(rows, {**SUCCESS, 'Paper': 'paper'}, 'Key poses from')}\n\n{note}"


def _accuracy(result: Quoted) -> str:
    columns: Columns = {
        "n": "poses",
        "Mean, mm": "position_mm_mean",
        "95th percentile, mm": "position_mm_p95",
    }
    note = (
        "Against the simulator, at the start of evaluated episodes, of the objects that a task touches. A "
        "learned object's frame stands anywhere on it: one rigid offset per object was fitted on the "
        "demonstrations. A dash: the yaw is not measured; the object is round, or known by patches and taken "
        "to stand as demonstrated. The paper's column compares its filter with another estimator, not with "
        "the truth."
    )
    objects = grid(result["objects"], {**columns, "Yaw, degrees": "orientation_deg_mean"}, "Object")
    tasks = zip(result["tasks"].items(), PAPER_MM, strict=True)
    rows = {task: {**row, "paper": mm} for (task, row), mm in tasks}
    return f"{objects}\n\n{grid(rows, {**columns, 'Paper, mm': 'paper'}, 'Task')}\n\n{note}"


def _experts(result: Quoted) -> str:
    return grid({**result["per_task"], "**all**": result}, STEPS, "Task")


def _few_shot(results: list[Quoted]) -> str:
    return grid({str(one["demonstrations"]): one for one in results}, LEARNED, "Demonstrations a task")


def _by_suite(results: list[Quoted]) -> str:
    return grid({one["suite"]: one for one in results}, LEARNED, "Suite")


def _new_tasks(results: list[Quoted]) -> str:
    rows = {result["task"]: result for result in results}
    columns: Columns = {"Demonstrations": "demonstrations", **SUCCESS, "Teaching, s": "teach_s"}
    mean = sum(result["success"] for result in results) / len(results)
    note = f"Mean over these {len(results)} tasks: {100 * mean:.1f} %. No gradient step after teaching."
    return f"{grid(rows, columns, 'Task left out of training')}\n\n{note}"


def _losses(result: Quoted) -> str:
    last = (
        f"At the end: training {result['training'][-1]}, validation {result['validation'][-1]}. Both over "
        "all frames as they were recorded, with the same noise for every checkpoint; training itself also "
        "draws perturbed copies, and rare phases more often."
    )
    return f"![Training and validation loss](images/{result['plot']})\n\n{last}"


def _equality(results: list[Quoted]) -> str:
    columns: Columns = {
        "Episodes": "n", "Equal": "equal", "Actions": "actions",
        "Largest difference": "largest_difference",
    }  # fmt: skip
    return grid({one["suite"]: one for one in results}, columns, "Suite")
