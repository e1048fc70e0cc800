"""What an instruction finds in a memory, for a person to look at: in words alone, or in a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_openspm.errors import DatasetError, InstructionError
from lerobot_openspm.memory.entry import MemoryEntry, SubTask
from lerobot_openspm.memory.indexed_entries import indexed, near
from lerobot_openspm.memory.instruction import parse_instruction
from lerobot_openspm.memory.key_vector import key_vector, key_vectors
from lerobot_openspm.memory.retrieval import ScoreWeights, semantic_candidates, semantic_score
from lerobot_openspm.observation import Observation, split_batch

if TYPE_CHECKING:
    from lerobot_openspm.modeling_openspm import OpenSPMPolicy


@dataclass(frozen=True)
class Hit:
    """An entry with the three terms of its score.

    Attributes:
        entry: The entry.
        semantic: ``S_sem``.
        geometric: ``S_geo``; None where no scene was looked at.
        total: The weighted sum of the terms there are.
    """

    entry: MemoryEntry
    semantic: float
    geometric: float | None
    total: float


@dataclass(frozen=True)
class Found:
    """What an instruction finds.

    Attributes:
        asked: The instruction's task elements.
        hits: The best entries first: those that retrieval considers, then the best one of each other key that
            is near, the nearest key first.
        refusal: Why the policy would not act on the instruction; "" if it would.
        considered: How many of the hits retrieval considers.
        seen: By name, whether the objects of the considered entries were found; empty without a scene.
        status: What the policy would do in the scene; "" without one.
    """

    asked: tuple[SubTask, ...]
    hits: tuple[Hit, ...]
    refusal: str
    considered: int
    seen: dict[str, bool]
    status: str = ""


def search_memory(instruction: str, entries: Sequence[MemoryEntry], weights: ScoreWeights) -> Found:
    """The entries for an instruction, without a scene: by ``S_sem`` and quality.

    Raises:
        InstructionError: The instruction cannot be read.
    """
    asked = parse_instruction(instruction)
    entries = near(asked, indexed(entries), semantic_score)
    refusal, considered = "", list[tuple[MemoryEntry, float]]()
    try:
        considered = semantic_candidates(instruction, entries)
    except InstructionError as error:
        refusal = str(error)
    hits = [_without_scene(entry, semantic, weights) for entry, semantic in considered]
    hits.sort(key=lambda hit: -hit.total)
    keys = {entry.key.sub_tasks for entry, _ in considered}
    others = [
        _without_scene(entry, semantic_score(asked, entry.key.sub_tasks), weights)
        for entry in _one_of_each_key(asked, entries)
        if entry.key.sub_tasks not in keys
    ]
    others.sort(key=lambda hit: -hit.semantic)  # of equal ones the nearer stays first
    return Found(asked, (*hits, *others), refusal, len(hits), {})


def _without_scene(entry: MemoryEntry, semantic: float, weights: ScoreWeights) -> Hit:
    return Hit(entry, semantic, None, weights.semantic * semantic + weights.quality * entry.quality)


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

    Raises:
        InstructionError: The instruction cannot be read.
        ObservationError: The observation lacks a camera, or its images are no pictures.
    """
    in_words = search_memory(
        observation.instruction, policy.require_experience().entries, policy.config.score_weights
    )
    if in_words.refusal:
        return in_words
    policy.reset()
    policy.act([observation])
    row = policy.rows[0]
    ranked = [Hit(one.entry, one.semantic, one.geometric, one.total) for one in row.ranked]
    others = in_words.hits[in_words.considered :]
    names = dict.fromkeys(name for hit in ranked for name in hit.entry.objects)
    seen = {name: name in row.layout for name in names}
    return Found(in_words.asked, (*ranked, *others), "", len(ranked), seen, row.status.value)


def observation_of(
    policy: OpenSPMPolicy, dataset: Any, episode: int, frame: int, instruction: str
) -> Observation:
    """One frame of a LeRobotDataset as the policy would see it, with another instruction.

    Args:
        policy: Says how the state vector is laid out.
        dataset: The ``LeRobotDataset``.
        episode: Number of the episode.
        frame: Number of the frame in it.
        instruction: What is asked.

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
    return split_batch(batch | {"task": [instruction]}, policy.config.layouts()[0])[0]
