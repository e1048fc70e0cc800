"""`openspm teach`: append a task to a checkpoint's memory from a few demonstrations, without training."""

from __future__ import annotations

import json
import shutil
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus

from lerobot_openspm.cli.options import EpisodesOption, require_checkpoint
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.memory.exchange import digest
from lerobot_openspm.memory.io import changing, read_memory, write_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.teaching import Lesson

if TYPE_CHECKING:
    from lerobot_openspm.modeling_openspm import OpenSPMPolicy


@dataclass
class Sam3dOption:
    """Where SAM 3D Objects is, for checkpoints whose shapes are its; see docs/sam3d.md."""

    sam3d_python: str | None = None  # of its environment
    sam3d_checkout: str | None = None  # folder of its repository


@dataclass
class PolicyOption:
    """What the checkpoint does not say."""

    cameras: str | None = None  # calibration of the demonstrations; theirs or the checkpoint's if not given
    segmenter: Sam3dOption = field(default_factory=Sam3dOption)


@dataclass
class TeachConfig:
    """Teach a checkpoint a task from a few demonstrations. Its weights stay as they are."""

    into: str  # folder of the checkpoint
    output: str | None = None  # folder of a new checkpoint to write instead of changing the old one
    dataset: EpisodesOption = field(default_factory=EpisodesOption)
    policy: PolicyOption = field(default_factory=PolicyOption)


def main(args: list[str]) -> None:
    """Teach, save, and print one JSON object."""
    start_s = time.monotonic()
    config = draccus.parse(TeachConfig, args=args)
    into, output = Path(config.into), Path(config.output) if config.output else None
    require_checkpoint(into, "--into")
    if output is not None and output.exists():
        raise OpenSPMError(f"{output} exists already; choose another --output, or remove it")
    meta = config.dataset.metadata()
    policy = _policy(config)
    known, lesson = policy.require_memory(), policy.teach(meta, config.dataset.episodes)
    if output is None:
        memory, lesson = _appended(policy, known, lesson, meta, config)
    else:
        memory = policy.require_memory()
        _write_copy(memory, into, output)
    print("\n".join(_lines(lesson)))
    summary = {
        "taught": list(lesson.instructions),
        "entries": len(lesson.entries),
        "entries_in_memory": len(memory.entries),
        "entries_known_before": sum(lesson.known_before.values()),
        "skipped": list(lesson.skipped),
        "objects_learned": list(lesson.objects_learned),
        "objects_recognised": list(lesson.objects_recognised),
        "output": str(output or into),
        "seconds": round(time.monotonic() - start_s, 1),
    }
    print(json.dumps(summary))


def _policy(config: TeachConfig) -> OpenSPMPolicy:
    from lerobot_openspm.modeling_openspm import OpenSPMPolicy

    policy = OpenSPMPolicy.from_pretrained(config.into)
    places = {name: place for name, place in vars(config.policy.segmenter).items() if place}
    try:
        segmenter = replace(policy.config.segmenter, **places)
    except ValueError as error:
        raise OpenSPMError(f"{config.into}: {error}") from error
    cameras = config.policy.cameras or policy.config.cameras
    policy.config = replace(policy.config, cameras=cameras, segmenter=segmenter)
    return policy


def _appended(
    policy: OpenSPMPolicy, known: Memory, lesson: Lesson, meta: Any, config: TeachConfig
) -> tuple[Memory, Lesson]:
    """Append a lesson to what the memory holds by now; what is saved, and the lesson.

    A lesson takes long, so others may change the memory meanwhile. Its key poses mean nothing in the frames
    of other models of its objects, so where these have changed the lesson is given again.
    """
    into = Path(config.into)
    with changing(into):
        now = read_memory(into)
        if not all(_same_model(known, now, name) for name in lesson.learned.objects):
            policy.memory = now
            lesson = policy.teach(meta, config.dataset.episodes)
        memory = now.appended(lesson.learned)
        write_memory(memory, into)
    before = Counter(entry.language for entry in now.entries)
    return memory, replace(lesson, known_before={task: before[task] for task in lesson.instructions})


def _same_model(known: Memory, now: Memory, name: str) -> bool:
    """Whether two memories know an object by the same model, or neither knows it."""
    models = [one.objects.get(name) for one in (known, now)]
    return len({digest(model) if model else "" for model in models}) == 1


def _write_copy(memory: Memory, into: Path, output: Path) -> None:
    """Write the checkpoint with another memory, as a whole or not at all."""
    beside = output.with_name(f".{output.name}.partial")
    if beside.exists():  # of a run that was interrupted
        shutil.rmtree(beside)
    shutil.copytree(into, beside)
    write_memory(memory, beside)
    beside.rename(output)


def _lines(lesson: Lesson) -> list[str]:
    """What was learned, for a person."""
    counts = Counter(entry.language for entry in lesson.entries)
    lines = []
    for task, before in lesson.known_before.items():
        known = f", beside {before} that the memory had" if before else ""
        lines.append(f"{task!r}: {counts[task]} new {'entries' if counts[task] > 1 else 'entry'}{known}")
        entry = next(entry for entry in lesson.entries if entry.language == task)
        lines.append(f"  {' > '.join(pose.phase for pose in entry.key_poses)}")
    return lines
