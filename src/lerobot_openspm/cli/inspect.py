"""`openspm inspect`: the memory of a checkpoint, in words and numbers a person can read."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np

from lerobot_openspm.experience import load_experience
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import MemoryEntry, MemoryKeyPose


@dataclass
class InspectConfig:
    """Show the memory of a checkpoint.

    Args:
        path: Folder of the checkpoint or of a mined memory.
        instruction: Show only entries whose instruction contains this.
        limit: Show at most this many entries.
    """

    path: str = "outputs/memory"
    instruction: str = ""
    limit: int = 10


def main(args: list[str]) -> None:
    """Print the entries, then one JSON object."""
    config = draccus.parse(InspectConfig, args=args)
    experience = load_experience(Path(config.path))
    shown = [entry for entry in experience.entries if config.instruction in entry.language]
    for entry in shown[: config.limit]:
        print("\n".join(_lines(entry)), end="\n\n")
    per_task = Counter(entry.language for entry in experience.entries)
    print(
        json.dumps(
            {"entries": len(experience.entries), "shown": len(shown[: config.limit]), "per_task": per_task}
        )
    )


def _constraint(pose: MemoryKeyPose) -> str:
    if pose.axis is None:
        return ""
    along = " ".join(f"{x:.2f}" for x in pose.axis.direction)
    if pose.axis.kind == "slide":
        return f"  slides {1000 * pose.axis.amount:.0f} mm along {along}"
    return f"  turns {np.rad2deg(pose.axis.amount):.0f} deg about {along}"


def _lines(entry: MemoryEntry) -> list[str]:
    head = f"{entry.language!r} from {entry.source}, version {entry.version}, quality {entry.quality:.2f}"
    names = f"{'phase':10s} {'place':18s} {'axes':18s}"
    columns = f"  {names} {'hand in its frame, mm':>24s} {'turn, deg':>22s} gripper conf."
    rows = []
    for pose in entry.key_poses:
        mm = " ".join(f"{1000 * x:7.1f}" for x in pose.T_obj_ee[:3, 3])
        deg = " ".join(f"{np.rad2deg(x):6.1f}" for x in se3.log_so3(pose.T_obj_ee[:3, :3]))
        gripper = "closed" if pose.closed else "open"
        names = f"{pose.phase:10s} {pose.anchor.place:18s} {pose.anchor.axes:18s}"
        rows.append(f"  {names} {mm:>24s} {deg:>22s} {gripper:7s} {pose.confidence:.2f}{_constraint(pose)}")
    return [head, columns, *rows]
