"""The part of ``docs/results.md`` on perception: poses along episodes, noise, disturbances, cameras."""

from __future__ import annotations

from typing import Any

from benchmarks.libero.tables import PAPER_MM
from benchmarks.markdown import SUCCESS, Columns, Quoted, chapter, grid, section, table

INTRODUCTION = """# Perception

Poses are compared with the simulator's at every step of episodes from seeds (5000 on) that no other figure
was taken on, while the policy acts. Scenes of LIBERO are drawn as its own initial states are. "Filtered" is
what the policy follows; "unfiltered" keeps each picture's own estimate until the next and knows nothing of
the hand; "one view" is the filter with the first camera alone. Orientation is the whole rotation, up to what
truly looks the same: of round objects the tilt alone; until it is touched, an object known by patches is
taken to stand as demonstrated. Failed episodes count to their end."""
CALIBRATION = ("calibration", "calibration_libero")
NOISE = ("measurement_noise", "measurement_noise_libero")
POSES: Columns = {
    "Poses": "poses",
    "Unknown": "unknown",
    "Mean, mm": "position_mm_mean",
    "95th percentile, mm": "position_mm_p95",
    "Orientation, degrees": "orientation_deg_mean",
}
ERRORS: Columns = {
    "Mean, mm": "position_mm_mean",
    "Largest, mm": "position_mm_max",
    "Mean, degrees": "rotation_deg_mean",
    "Largest, degrees": "rotation_deg_max",
    "Within 5 mm, 0.5 degrees": "within",
}


def perception_sections() -> list[str]:
    """The chapter, of what was measured."""
    return chapter(
        INTRODUCTION,
        [
            section("Poses along LIBERO-GOAL episodes", "perception_libero", _along_libero),
            section("Poses along tabletop episodes", "perception_tabletop", _along),
            section("Covariance of the measured poses", NOISE, _noise),
            section("Objects displaced or dropped", "tracking", _disturbed),
            section("Cameras moved", "cameras", _disturbed),
            section("Cameras calibrated from demonstrations", CALIBRATION, _calibration),
        ],
    )


def _along_libero(result: Quoted) -> str:
    """The same with the paper's errors by task."""
    tasks = zip(result["tasks"].items(), PAPER_MM, strict=True)
    return _along(result, {name: {**one, "paper": mm} for (name, one), mm in tasks}, {"Paper, mm": "paper"})


def _along(result: Quoted, tasks: dict[str, Any] | None = None, more: Columns | None = None) -> str:
    parts = {"filtered, at the start": result["start"], "filtered, in the hand": result["held"]}
    return "\n\n".join(
        [
            grid({**result["variants"], **parts}, POSES),
            grid(tasks or result["tasks"], {**POSES, **(more or {})}, "Task"),
            grid(result["objects"], POSES, "Object"),
            _cost(result),
        ]
    )


def _cost(result: Quoted) -> str:
    cost = result["cost"]
    found, one, twenty = cost["perception"], cost["filter_us_1_object"], cost["filter_us_20_objects"]
    first, followed = found["first_ms"], found["followed_ms"]
    moved = ""
    if elsewhere := cost.get("moved"):
        anew, again = elsewhere["first_ms"], elsewhere["followed_ms"]
        moved = (
            f" Where objects are exchanged it takes {anew['median']:.0f} ms ({anew['p99']:.0f}), where "
            f"{elsewhere['found']} are found, and {again['median']:.0f} ms ({again['p99']:.0f}) when they "
            "are followed with all looks that are remembered. The first look there searches the whole table "
            "by their surfaces; where objects stand as shown, patches find them. It is timed in one scene, "
            "in which two round objects have moved and the third has not. What is not round, furniture "
            "above all, takes several times as long, see the first looks of all objects where places are "
            "exchanged."
        )
    return (
        f"{result['episodes']} episodes; the ten tasks share their scenes seed by seed. A look for "
        f"{found['objects']} objects in {found['views']} views of 256 pixels takes {first['median']:.1f} ms "
        f"(median; p99 {first['p99']:.1f}) at the start of an episode, where {found['found']} of them are "
        f"found and the cameras are compared, and {followed['median']:.1f} ms ({followed['p99']:.1f}) when "
        f"they are followed.{moved} A step of the filter takes {one['median']:.0f} us for one object and "
        f"{twenty['median']:.0f} us for twenty; one thread."
    )


def _noise(results: list[Quoted]) -> str:
    rows = [
        [kind, what, one["n"], one["in_use"]["inside_95"], one["in_use"]["squared_mean_per_dimension"]]
        for result in results
        for kind, ones in result["kinds"].items()
        for what, one in ones.items()
    ]
    heads = [
        "Known by",
        "Error of",
        "Estimates",
        "Share inside the 95 % ellipse",
        "Mean square per dimension",
    ]
    note = (
        "Of single estimates while the policy acts, under the covariance that the filter is given, by "
        "the weights in `tracking/measurement.py`: a calibrated one has 0.95 inside and a mean square of 1."
    )
    return f"{table(heads, rows)}\n\n{note}"


def _disturbed(result: Quoted) -> str:
    return grid(result["conditions"], SUCCESS)


def _calibration(results: list[Quoted]) -> str:
    rows = {
        f"{camera}, {way}": one
        for result in results
        for camera, ways in result["cameras"].items()
        for way, one in ways.items()
    }
    note = (
        f"From {results[0]['episodes']} episodes, one of each task, {results[0]['n']} choices of them. See "
        "[calibration.md](calibration.md)."
    )
    return f"{grid(rows, ERRORS, 'Camera')}\n\n{note}"
