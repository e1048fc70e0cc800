"""What an instruction finds in a memory, for a person to look at: in words alone, or in a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_openspm.errors import DatasetError, InstructionError
from lerobot_openspm.language.names import TABLE_NAMES, NameSimilarity
from lerobot_openspm.memory.compose import Candidate, plan_parts
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.indexed_entries import indexed, near
from lerobot_openspm.memory.key_vector import key_vector, key_vectors
from lerobot_openspm.memory.looks import UNKNOWN_LOOKS, Looks
from lerobot_openspm.memory.retrieval import LAMBDAS, read_instruction, retrieve, semantic_score
from lerobot_openspm.perception.observation import Observation, split_batch
from lerobot_openspm.types import SubTask

if TYPE_CHECKING:
    from lerobot_openspm.modeling_openspm import OpenSPMPolicy


@dataclass(frozen=True)
class Hit:
    """An entry with the three terms of its score.

    Attributes:
        entry: What would be executed: an entry of the memory, or one sub-task of it.
        sources: The entry of the memory, or the two that it was put together from: grasp and place.
        semantic: ``S_sem``.
        geometric: ``S_geo``; None where no scene was looked at.
        total: The weighted sum of the terms there are.
    """

    entry: MemoryEntry
    sources: tuple[MemoryEntry, ...]
    semantic: float
    geometric: float | None
    total: float


@dataclass(frozen=True)
class Found:
    """What an instruction finds.

    Attributes:
        asked: The instruction's task elements.
        parts: What the instruction would be carried out by: for each part, in order, what retrieval
            considers, best first. Empty where it is refused.
        others: The best entry of each other key that is near, the nearest key first.
        refusal: Why the policy would not act on the instruction; "" if it would.
        seen: By name, whether the objects of the first part's entries were found; empty without a scene.
        status: What the policy would do in the scene; "" without one.
    """

    asked: tuple[SubTask, ...]
    parts: tuple[tuple[Hit, ...], ...]
    others: tuple[Hit, ...]
    refusal: str
    seen: dict[str, bool]
    status: str = ""


def search_memory(
    instruction: str,
    entries: Sequence[MemoryEntry],
    names: NameSimilarity = TABLE_NAMES,
    looks: Looks = UNKNOWN_LOOKS,
) -> Found:
    """What an instruction would be carried out by, without a scene: by ``S_sem`` and quality.

    Args:
        instruction: What is asked.
        entries: The memory.
        names: Says which names mean the same thing.
        looks: What is known of the objects, to put one where another was shown.

    Raises:
        InstructionError: There is not a word in the instruction.
    """
    entries = indexed(entries)
    asked = read_instruction(instruction, entries, names)
    score = partial(semantic_score, names=names)
    entries = near(asked, entries, score)
    refusal, plan = "", tuple[tuple[Candidate, ...], ...]()
    try:
        plan = plan_parts(instruction, asked, entries, names, looks)
    except InstructionError as error:
        refusal = str(error)
    parts = tuple(_ranked(part, names) for part in plan)
    keys = {source.key.sub_tasks for part in plan for one in part for source in one.sources}
    others = [
        _without_scene(entry, (entry,), score(asked, entry.key.sub_tasks))
        for entry in _one_of_each_key(asked, entries)
        if entry.key.sub_tasks not in keys
    ]
    others.sort(key=lambda hit: -hit.semantic)  # of equal ones the nearer stays first
    return Found(asked, parts, tuple(others), refusal, {})


def _ranked(part: Sequence[Candidate], names: NameSimilarity) -> tuple[Hit, ...]:
    """What a part can be carried out by, in the order of retrieval, where nothing is known of the scene."""
    sources = {id(one.entry): one.sources for one in part}
    found = retrieve([(one.entry, one.semantic) for one in part], lambda _: 1.0, names)
    return tuple(_without_scene(one.entry, sources[id(one.entry)], one.semantic) for one in found)


def _without_scene(entry: MemoryEntry, sources: tuple[MemoryEntry, ...], semantic: float) -> Hit:
    lambda_s, _, lambda_r = LAMBDAS
    return Hit(entry, sources, semantic, None, lambda_s * semantic + lambda_r * entry.quality)


def _one_of_each_key(asked: Sequence[SubTask], entries: Sequence[MemoryEntry]) -> list[MemoryEntry]:
    """The entry of best quality of every key, the key nearest to what is asked first."""
    best: dict[tuple[SubTask, ...], MemoryEntry] = {}
    for entry in entries:
        if entry.quality > getattr(best.get(entry.key.sub_tasks), "quality", -1.0):
            best[entry.key.sub_tasks] = entry
    cosines = key_vectors(list(best)) @ key_vector(asked)
    nearest = list(best.values())
    return [nearest[i] for i in np.argsort(-cosines, kind="stable")]


def search_scene(policy: OpenSPMPolicy, observation: Observation) -> Found:
    """The entries for an observation's instruction, scored as the policy does when it begins to act.

    Of several workplaces they are those of the one where the policy takes itself to be.

    What comes after the first part will be chosen in the scene that the first one leaves, so the entries of
    later parts have no ``S_geo``.

    Raises:
        InstructionError: There is not a word in the instruction.
        ObservationError: The observation lacks a camera, or its images are no pictures.
    """
    _, memory, entries = policy.workplace(observation)
    in_words = search_memory(observation.instruction, entries, policy.names, memory.looks)
    if in_words.refusal:
        return in_words
    policy.reset()
    policy.act([observation])
    controller = policy.episodes[0].controller
    state = controller.state
    if state.refusal:
        return replace(in_words, parts=(), refusal=state.refusal, status=state.status.value)
    sources = {id(one.entry): one.sources for one in state.parts[0]}
    ranked = tuple(
        Hit(one.entry, sources[id(one.entry)], one.semantic, one.geometric, one.total) for one in state.ranked
    )
    needed = dict.fromkeys(name for hit in ranked for name in hit.entry.objects)
    poses = controller.scene.tracker.poses(observation.hand.T_world_ee)
    seen = {name: name in poses for name in needed}
    return replace(in_words, parts=(ranked, *in_words.parts[1:]), seen=seen, status=state.status.value)


def observation_of(
    policy: OpenSPMPolicy, dataset: Any, episode: int, frame: int, instruction: str | None = None
) -> Observation:
    """One frame of a LeRobotDataset as the policy would see it.

    Args:
        policy: Says how the state vector is laid out.
        dataset: The ``LeRobotDataset``.
        episode: Number of the episode.
        frame: Number of the frame in it.
        instruction: What is asked; the episode's own task if not given.

    Raises:
        DatasetError: There is no such episode or frame.
        ObservationError: The frame is not what the policy takes.
    """
    meta, where = dataset.meta, f"dataset {dataset.repo_id}"
    if not 0 <= episode < meta.total_episodes:
        raise DatasetError(f"{where} has episodes 0 to {meta.total_episodes - 1}, got --episode={episode}")
    first, last = (int(meta.episodes[name][episode]) for name in ("dataset_from_index", "dataset_to_index"))
    if not 0 <= frame < last - first:
        raise DatasetError(
            f"episode {episode} of {where} has frames 0 to {last - first - 1}, got --frame={frame}"
        )
    item: dict[str, Any] = dataset[first + frame]
    batch = {name: value[None] for name, value in item.items() if name.startswith("observation.")}
    task = item["task"] if instruction is None else instruction
    return split_batch(batch | {"task": [task]}, policy.config.layouts()[0])[0]
