"""Of ``docs/results.md`` what is found of LIBERO's objects at a first look, and of its cameras."""

from __future__ import annotations

from benchmarks.figures import FIGURES
from benchmarks.markdown import Columns, Quoted, grid, interval, percent, section

# Of what scenes a figure is, where its suite does not say it.
SCENES = {
    "places_libero_object": "LIBERO's own draw hardly moves these objects between the scenes of a task, some "
    "not at all, so this figure proves little; the next one is of the same objects, exchanged.",
    "places_libero_object_exchanged": "The places of all objects but the basket are dealt out anew at "
    "random, so that some keep theirs by chance. LIBERO's range of each place was widened by 2 cm on every "
    "side.",
    "places_libero_goal_exchanged": "One or two pairs of objects are exchanged, and furniture in some "
    "scenes. The other objects stand as LIBERO draws them.",
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


def places_sections() -> list[str]:
    """Sections of the chapter on LIBERO-GOAL; those of other suites' objects are among them."""
    return [
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
        section("Cameras that are not where they should be", "wrong_calibration_libero", _wrong_calibration),
    ]


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
