"""LIBERO's part of ``docs/results.md``: the paper's tables with our figures beside its own."""

from __future__ import annotations

from benchmarks.figures import FIGURES
from benchmarks.libero.failures import FAR_OFF_MM as FAR_OFF
from benchmarks.markdown import (
    STEPS,
    SUCCESS,
    Columns,
    Quoted,
    chapter,
    grid,
    interval,
    looked_at,
    percent,
    section,
    share,
    table,
)

INTRODUCTION = """# On LIBERO-GOAL

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
# Millimetres by task, of the paper's filter against its own visual reference.
PAPER_MM = (4.3, 4.1, 5.0, 14.7, 5.5, 5.7, 4.6, 5.1, 4.0, 5.0)
FAR_OFF_MM = 10.0
CONSTRAINED = ("push", "open", "turn", "drawer")
CONTACTS: Columns = {
    "Touched others": lambda row: share(row["touched"]),
    "Moved others": lambda row: share(row["moved"]),
}
TOUCHED = (
    "Others: objects that neither the instruction nor the goal names. Shares of the episodes, failed ones "
    "too, in which the arm, the hand or what it carried or pushed touched one, and in which one was moved by "
    "more than 1 cm."
)

SEEN_BEFORE = (
    "[libero.md](libero.md) says how often these episodes were run while the policy was developed, and what "
    "was learned from them."
)
SORTED = (
    "Failed episodes by a rule; the first that fits counts. Words: the instruction was not understood. "
    "Perception: an object was not found or was lost, a camera was not believed, or a pose was more than "
    f"{FAR_OFF:.0f} mm off at the first look. Reach: no remembered motion passed the checks of reach and "
    "clearance. Grasp: the hand did not keep hold of all that it was to take hold of. Placing: the rest, "
    "gripped or pushed but without reaching the goal. Collisions are told by a look alone: objects that are "
    "not of the task are touched in episodes that succeed too."
)
# Of what scenes a figure is, where its suite does not say it.
SCENES = {
    "places_libero_object": "LIBERO's own draw hardly moves these objects between the scenes of a task, some "
    "not at all, so this figure proves little; the next one is of the same objects, exchanged.",
    "places_libero_object_exchanged": "The places of all objects but the basket are dealt out anew at "
    "random: the soup stands elsewhere in 118 of 150 scenes, the cheese in 114 of 150, the dressing in 84 of "
    "100. LIBERO's range of each place was widened by 2 cm on every side.",
    "places_libero_goal_exchanged": "One or two pairs of objects are exchanged, and furniture in some "
    "scenes: the bowl stands elsewhere in 65 of 100 scenes, the cheese in 64, the plate in 58, the bottle "
    "in 55, the cabinet in 43, the stove in 35, the rack in 26.",
}
PLACES: Columns = {
    "Known by": lambda row: row["learned"] or "not learned",
    "Grasped in": "grasped",
    "Found": lambda row: percent(row["found"]),
    "Within 10 mm": lambda row: percent(row["within_10_mm"]),
    "95 % interval": lambda row: interval(row["within_10_mm"]),
    "Scenes": lambda row: row["found"]["n"],
    "Median, mm": "position_mm_median",
    "95th percentile, mm": "position_mm_p95",
    "Median yaw, degrees": "yaw_deg_median",
    "All of several": lambda row: f"{row['several']['all_within_10_mm']} of {row['several']['n']}",
    "Reported where there is none": lambda row: f"{row['absent']['reported']} of {row['absent']['n']}",
}


def libero_sections() -> list[str]:
    """The chapter, of what was measured."""
    few = sorted(
        (n for n in FIGURES if n.startswith("libero_few_shot_")), key=lambda n: int(n.rsplit("_", 1)[1])
    )
    new = [name for name in FIGURES if name.startswith("libero_new_task_")]
    return chapter(
        INTRODUCTION,
        [
            section("Success from pixels", "libero_goal", _main),
            section("Time of a decision", "libero_latency", _latency),
            section("Failures", "libero_goal", _failures),
            section("Objects exchanged (LIBERO-PRO)", "libero_goal_swap", _variant),
            section("Instructions in other words (LIBERO-PRO)", "libero_goal_lan", _variant),
            section("Objects that look otherwise (LIBERO-PRO)", "libero_goal_object", _variant),
            section("How key poses are followed", "libero_ablations", _execution),
            section("Where key poses come from", "libero_ablations", _memory),
            section("Error of the object poses", "libero_accuracy", _accuracy),
            section("Objects of libero_spatial, found by a first look", "places_libero_spatial", _places),
            section("Objects of libero_object, found by a first look", "places_libero_object", _places),
            section(
                "Objects of libero_object where places are exchanged, found by a first look",
                "places_libero_object_exchanged",
                _places,
            ),
            section(
                "Objects of LIBERO-GOAL where places are exchanged, found by a first look",
                "places_libero_goal_exchanged",
                _places,
            ),
            section(
                "Kinds of objects, and how many demonstrations",
                [n for n in FIGURES if n.startswith("places_libero_goal")],
                _kinds,
            ),
            section(
                "Cameras that are not where they should be", "wrong_calibration_libero", _wrong_calibration
            ),
            section("Few demonstrations", [*few, "libero_goal"], _few_shot),
            section("A new task by memory alone", new, _new_tasks),
            section("Loss over epochs", "libero_losses", _losses),
            section("The harness against lerobot-eval", "libero_equality", _equality),
        ],
    )


def _variant(result: Quoted) -> str:
    per_task = grid({"all ten tasks": result, **result["per_task"]}, {**STEPS, **CONTACTS})
    return f"{per_task}\n\n{TOUCHED} {SEEN_BEFORE}\n\n{_sorted(result)}{looked_at(result)}"


def _sorted(result: Quoted) -> str:
    """How many episodes failed by what, as `failures` sorts them."""
    counts = result["failures"]
    return f"{table(['Failed by', *counts], [['episodes', *counts.values()]])}\n\n{SORTED}"


def _main(result: Quoted) -> str:
    name = f"**OpenSPM, {result['demonstrations']} demonstrations a task**"
    ours = [name, None, None, f"**{percent(result)}**"]
    rows = [[name, size, length, f"{rate} %"] for name, size, length, rate, _ in PUBLISHED]
    compared = table(["", "Parameters", "Chunk", "Success"], [*rows, ours])
    seconds = result["mine_and_train_s"]
    taken = "was interrupted" if seconds is None else f"took {seconds:.0f} s"
    per_task = grid({**result["per_task"], "**all**": result}, {**STEPS, **CONTACTS}, "Task")
    return (
        f"{compared}\n\nThe rows above ours are quoted from the paper.\n\n{per_task}\n\n{TOUCHED}\n\n"
        f"Mining and training {taken}. {SEEN_BEFORE}"
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
        f"takes {first['median']:.2f} ms ({first['p99']:.2f}, n = {first['n']}). One thread."
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
    return grid(rows, {**STEPS, "Paper": "paper"})


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


def _places(result: Quoted) -> str:
    learned, found = result["learned"], result["found"]
    rows = {name: {**told, **found[name]} for name, told in learned["objects"].items()}
    sure, spent = result["sure"], result["first_look_cpu_ms"]
    note = (
        f"All that the hand touched in {learned['episodes']} demonstrations, and in how many it took hold of "
        "it. Seeded scenes that none of them shows; the hand is somewhere else in each. Shares are of the "
        "scenes that hold the object, whether it was learned or not; of several of a kind the one that the "
        "instruction is about counts, as the policy tells it, and their column says in how many scenes each "
        "of them is within 10 mm. A round object is where its axis is. "
        f"{percent(sure)} ({interval(sure)}) of {sure['n']} estimates with a confidence above 0.95 are "
        "within 10 mm and 10 degrees. "
        f"Learning the objects took {learned['learn_objects_s']:.0f} s of the "
        f"{learned['seconds']:.0f} s of mining. A first look at all of them takes {spent['median']:.0f} ms "
        f"of a processor (95th percentile {spent['p95']:.0f}). {SCENES.get(result.name, '')}"
    )
    return f"{grid(rows, PLACES, 'Object')}\n\n{note.strip()}"


def _kinds(results: list[Quoted]) -> str:
    rows = {
        f"{result['kinds']}, {'exchanged' if result['exchanged'] else 'as in LIBERO'}, "
        f"{result['demonstrations']} a task": {
            "learned": _count_learned(result), "sure": result["sure"],
            "spent": result["first_look_cpu_ms"]["median"], **result["all"],
        }
        for result in results
    }  # fmt: skip
    columns: Columns = {
        "Learned": "learned",
        **{head: PLACES[head] for head in ("Found", "Within 10 mm", "95 % interval", "Median, mm")},
        "Right of those above 0.95": lambda row: f"{percent(row['sure'])} of {row['sure']['n']}",
        "Its 95 % interval": lambda row: interval(row["sure"]),
        "First look, ms": "spent",
    }
    note = (
        "The kinds that are asked to learn, where objects stand in the scenes, as LIBERO draws them or in "
        "one another's places, and from how many demonstrations a task. All objects that the hand touched, "
        "the same scenes for all. Boxes are learned from a segmenter's masks and are not compared. Where "
        "all are asked, objects that begin at a few places are learned by their surface, and those that "
        "are moved about by their shape: see [method.md](method.md)."
    )
    return f"{grid(rows, columns, 'Kinds')}\n\n{note}"


def _count_learned(result: Quoted) -> str:
    told = result["learned"]["objects"].values()
    return f"{sum(one['learned'] is not None for one in told)} of {len(told)}"


def _wrong_calibration(result: Quoted) -> str:
    rows = {
        f"{camera.rpartition('.')[2]}, {error}": row
        for camera, by_error in result["cameras"].items()
        for error, row in by_error.items()
    }
    columns: Columns = {
        "Told": percent, "95 % interval": interval, "Named": lambda row: f"{row['named']} of {row['n']}",
    }  # fmt: skip
    right = result["right"]
    note = (
        "Seeded scenes of libero_goal in which one camera at a time is not where its calibration says. Axes "
        "are the camera's own; it looks along its z. Told: at the first look, before anything moves, some "
        "camera is not believed. Named: that which is off alone; of two cameras it cannot be told which is, "
        "and both are named. An error along the line of sight, or about it, hardly moves what a camera looks "
        "at. `image` stands in the room, `image2` goes with the hand. With both where they should be, one is "
        "not believed in "
        f"{percent(right)} of {right['n']} scenes."
    )
    return f"{grid(rows, columns, 'Camera and error')}\n\n{note}"


def _few_shot(results: list[Quoted]) -> str:
    rows = {str(result["demonstrations"]): result for result in results}
    more = {"Mean steps": "mean_steps", "Mining and training, s": "mine_and_train_s"}
    return grid(rows, {**SUCCESS, **more}, "Demonstrations a task")


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


def _equality(result: Quoted) -> str:
    return (
        f"{result['equal']} of {result['n']} episodes by LeRobot's own rollout and by the harness, "
        "which renders only when the policy looks, took the same actions bit by bit "
        f"({result['actions']} actions; largest difference {result['largest_difference']})."
    )
