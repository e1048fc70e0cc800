"""Several workplaces in one policy: their memories lie beside one another, and an episode acts by one.

At a workplace the cameras and the robot's base keep their places, and a name means the same object. A
checkpoint holds the first one's memory as any other does, and those of others in `workplaces/1`,
`workplaces/2` and so on. The flow model works relative to its target, so all share the first one's.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from lerobot.configs import PreTrainedConfig

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.errors import InstructionError, OpenSPMError
from lerobot_openspm.language.names import NameSimilarity
from lerobot_openspm.memory.compose import Candidate, plan_parts
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.io import WORKPLACES, read_memory, workplaces_of, write_memory
from lerobot_openspm.memory.looks import UNKNOWN_LOOKS, Looks
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.memory.merging import SOURCES, demonstration_of
from lerobot_openspm.memory.retrieval import read_instruction
from lerobot_openspm.perception.observation import Observation

# Where demonstrations begin, the hand is at the edge of what they covered: so far outside it is still there.
NEAR_M = 0.05
# What a policy has once, whatever the workplace.
COMMON = (
    "input_features", "output_features", "state_layout", "action_layout", "rotation", "control_hz",
    "hand_radius_m", "perception", "segmenter", "name_embeddings", "lexicon", "conditioning", "chunk_size",
    "n_action_steps", "num_inference_steps", "execution", "tracking", "reach_margin_m", "min_clearance_m",
)  # fmt: skip


def folder(checkpoint: Path, number: int) -> Path:
    """Where a checkpoint keeps the memory of a workplace; that of the first, 0, is the checkpoint's own."""
    return checkpoint / WORKPLACES / str(number) if number else checkpoint


def folders(checkpoint: Path) -> list[Path]:
    """The folders with the memories of a checkpoint's workplaces, the first one's first.

    Others may be left there from before: the Hub deletes nothing. Raises MemoryFormatError.
    """
    return [folder(checkpoint, i) for i in range(workplaces_of(checkpoint))]


def write(memories: Sequence[Memory], checkpoint: Path) -> None:
    """Write the memories of all workplaces into a checkpoint's folder, and remove those of others there.

    The first one's says how many there are, so it is written last.
    """
    for i in reversed(range(len(memories))):
        n_workplaces = 1 if i else len(memories)
        write_memory(replace(memories[i], workplaces=n_workplaces), folder(checkpoint, i))
    for path in (checkpoint / WORKPLACES).glob("*"):
        if path.name.isdecimal() and int(path.name) >= len(memories):
            shutil.rmtree(path)


def choose(
    observation: Observation,
    memories: Sequence[Memory],
    entries: Sequence[Sequence[MemoryEntry]],
    names: NameSimilarity,
) -> int:
    """At which workplace an episode begins, counted from 0.

    The hand tells: it is where the demonstrations of that workplace had it, or nearly. Among several the
    instruction does: it is the one that knows it best.

    Args:
        observation: The first one.
        memories: One of each workplace.
        entries: Theirs, with their index.
        names: Tells which names mean the same thing.
    """
    if len(memories) == 1:
        return 0
    outside = [_outside(memory, observation.hand.T_world_ee[:3, 3]) for memory in memories]
    near = [i for i, metres in enumerate(outside) if metres <= min(outside) + NEAR_M]
    return max(near, key=lambda i: _knows(observation.instruction, entries[i], names, memories[i].looks))


def _outside(memory: Memory, position: np.ndarray) -> float:
    """How far a position ``(3,)`` is from where the demonstrations' hand has been, metres; 0 inside."""
    low, high = memory.robot.workspace
    return float(np.linalg.norm(np.maximum(np.maximum(low - position, position - high), 0.0)))


def _knows(
    instruction: str, entries: Sequence[MemoryEntry], names: NameSimilarity, looks: Looks = UNKNOWN_LOOKS
) -> tuple[bool, bool, float]:
    """How well a memory knows an instruction.

    Returns:
        Whether one demonstration shows all of it, whether in these words, and how near it is in meaning; -1
        where it cannot be carried out.
    """
    try:
        parts = plan_parts(instruction, read_instruction(instruction, entries, names), entries, names, looks)
    except InstructionError:
        return False, False, -1.0
    is_worded = any(
        source.language == instruction for part in parts for one in part for source in one.sources
    )
    meaning = min(max(one.semantic for one in part) for part in parts)
    return bool(set.intersection(*_episodes(parts))), is_worded, meaning


def _episodes(parts: Sequence[Sequence[Candidate]]) -> list[set[str]]:
    """The demonstrations that show each part; what is asked twice, only those that do it twice."""
    times = Counter(part[0].asked for part in parts)
    found = []
    for part in parts:
        shown = {
            name for one in part if len(one.sources) == 1 for name in one.sources[0].source.split(SOURCES)
        }
        counts = Counter(map(demonstration_of, shown))
        found.append({episode for episode, count in counts.items() if count >= times[part[0].asked]})
    return found


def join(paths: Sequence[Path], output: Path) -> list[Memory]:
    """Write the checkpoint of several workplaces, as a whole or not at all; the memories in it.

    Args:
        paths: Folders of their checkpoints.
        output: Folder of the new one.

    Raises:
        OpenSPMError: There is one only, they do not see and act alike, or there is something at `output`.
    """
    if len(paths) < 2:
        raise OpenSPMError(
            f"got {len(paths)} checkpoints to join, expected at least two: --policy.paths=[A,B]"
        )
    if output.exists():
        raise OpenSPMError(f"{output} exists already; choose another --output_dir, or remove it")
    _check_alike(paths)
    beside = output.with_name(f".{output.name}.partial")
    if beside.exists():  # of a run that was interrupted
        shutil.rmtree(beside)
    shutil.copytree(paths[0], beside, ignore=shutil.ignore_patterns(WORKPLACES))
    memories = [read_memory(one) for path in paths for one in folders(path)]
    write(memories, beside)
    beside.rename(output)
    return memories


def _check_alike(paths: Sequence[Path]) -> None:
    """Refuse policies that do not see and act alike. Raises OpenSPMError that names what differs."""
    first, *others = (PreTrainedConfig.from_pretrained(path) for path in paths)
    for path, other in zip(paths[1:], others, strict=True):
        for one, name in ((first, paths[0]), (other, path)):
            if not isinstance(one, OpenSPMConfig):
                raise OpenSPMError(f"{name} is a policy of type {one.type}, expected openspm")
        for name in COMMON:
            ours, theirs = getattr(first, name), getattr(other, name)
            if ours != theirs:
                raise OpenSPMError(
                    f"{path}: its {name} is {str(theirs)[:300]}, that of {paths[0]} {str(ours)[:300]}; one "
                    "policy has one, so train both alike"
                )
