"""The part of ``docs/results.md`` on perception: poses along episodes, disturbances, cameras, masks."""

from __future__ import annotations

from typing import Any

from benchmarks.libero.tables import PAPER_POSES
from benchmarks.markdown import interval, part, percent, table

INTRODUCTION = """# Results of perception

Poses are compared with the simulator's at every step of episodes from seeds (5000 on) that no other figure
was taken on, while the policy acts. Scenes of LIBERO are drawn as its own initial states are. "Filtered" is
what the policy follows; "unfiltered" keeps each picture's own estimate until the next and knows nothing of
the hand; "one view" is the filter with the first camera alone. Orientation is the whole rotation, up to what
truly looks the same: of round objects the tilt alone. Failed episodes count to their end."""
VARIANTS = {"filtered": "filtered", "unfiltered": "unfiltered", "one_view": "one view"}


def perception_parts() -> list[str]:
    """All sections; one whose JSON is missing says so."""
    return [
        INTRODUCTION,
        part("Poses along LIBERO-GOAL episodes", "perception_libero", _along_libero, "followed perception"),
        part("Poses along tabletop episodes", "perception_openspm_tabletop", _along, "followed perception"),
        part("Objects displaced or dropped", "tracking", _disturbed, "followed tracking"),
        part("Cameras moved", "cameras", _disturbed, "followed cameras"),
        part("Cameras calibrated from demonstrations", "calibration", _calibration, "calibration"),
        part("Boxes and shapes from true masks", "masks", _masks, "masks"),
    ]


def _along_libero(result: dict[str, Any]) -> str:
    return _along(result, [list(pair) for pair in PAPER_POSES])


def _along(result: dict[str, Any], paper: list[list[float]] | None = None) -> str:
    heads = ["Poses", "Unknown", "Mean, mm", "95th percentile, mm", "Orientation, degrees"]
    rows = [[VARIANTS[name], *_row(one)] for name, one in result["variants"].items()]
    rows += [
        ["filtered, at the start", *_row(result["start"])],
        ["filtered, in the hand", *_row(result["held"])],
    ]
    tasks = [[name.replace("_", " "), *_row(one)] for name, one in result["tasks"].items()]
    objects = [[name, *_row(one)] for name, one in result["objects"].items()]
    extra = []
    if paper is not None:
        tasks = [[*task, *pair] for task, pair in zip(tasks, paper, strict=True)]
        extra = ["Paper, mm", "Paper, degrees"]
    return "\n\n".join(
        [
            table(["", *heads], rows),
            table(["Task", *heads, *extra], tasks),
            table(["Object", *heads], objects),
            _cost(result),
        ]
    )


def _cost(result: dict[str, Any]) -> str:
    cost = result["cost"]
    found, one, twenty = cost["perception"], cost["filter_us_1_object"], cost["filter_us_20_objects"]
    first, followed = found["first_ms"], found["followed_ms"]
    return (
        f"{result['episodes']} episodes. Finding {found['objects']} objects in {found['views']} views of 256 "
        f"pixels takes {first['median']:.1f} ms (median; p99 {first['p99']:.1f}) at the first look and "
        f"{followed['median']:.1f} ms ({followed['p99']:.1f}) when they are followed; a step of the filter "
        f"takes {one['median']:.0f} us for one object and {twenty['median']:.0f} us for twenty; one thread."
    )


def _row(one: dict[str, Any]) -> list[Any]:
    names = ("poses", "unknown", "position_mm_mean", "position_mm_p95", "orientation_deg_mean")
    return [one[name] for name in names]


def _disturbed(result: dict[str, Any]) -> str:
    rows = [
        [name.replace("_", " "), percent(one), interval(one), one["n"]]
        for name, one in result["conditions"].items()
    ]
    return table(["", "Success", "95 % interval", "Episodes"], rows)


def _calibration(result: dict[str, Any]) -> str:
    rows = [
        [
            camera,
            way,
            one["position_mm_mean"],
            one["position_mm_max"],
            one["rotation_deg_mean"],
            one["rotation_deg_max"],
            one["within"],
        ]
        for camera, ways in result["cameras"].items()
        for way, one in ways.items()
    ]
    heads = [
        "Camera",
        "",
        "Mean, mm",
        "Largest, mm",
        "Mean, degrees",
        "Largest, degrees",
        "Within 5 mm, 0.5 degrees",
    ]
    note = (
        f"From {result['episodes']} episodes, one of each task, {result['n']} choices of them. See "
        "[calibration.md](calibration.md)."
    )
    return f"{table(heads, rows)}\n\n{note}"


def _masks(result: dict[str, Any]) -> str:
    kinds = [name for name in ("box", "demonstrations") if name in result]
    rows = [
        [name, *(value for kind in kinds for value in _mask_row(result[kind][name]))]
        for name in result[kinds[0]]
    ]
    heads = [f"{kind}, {what}" for kind in kinds for what in ("mean mm", "95th percentile", "yaw, degrees")]
    note = f"{result['n']} unseen scenes of the tabletop, the simulator's own masks, three cameras."
    return f"{table(['Object', *heads], rows)}\n\n{note}"


def _mask_row(one: dict[str, Any]) -> list[Any]:
    return [one["position_mm_mean"], one["position_mm_p95"], one["yaw_deg_mean"]]
