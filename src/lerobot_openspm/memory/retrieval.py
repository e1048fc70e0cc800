"""Retrieval by the paper's score: semantics, geometry, quality."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.memory.entry import MemoryEntry, SubTask
from lerobot_openspm.memory.instruction import parse_instruction

# Below this semantic score an entry is about something else.
MIN_SEMANTIC = 0.75


@dataclass(frozen=True)
class ScoreWeights:
    """The paper's lambda_s, lambda_g and lambda_r."""

    semantic: float = 1.0
    geometric: float = 0.5
    quality: float = 0.5


@dataclass(frozen=True)
class Scored:
    """An entry with the three terms of its score."""

    entry: MemoryEntry
    semantic: float
    geometric: float
    quality: float
    total: float


def semantic_candidates(instruction: str, entries: Sequence[MemoryEntry]) -> list[tuple[MemoryEntry, float]]:
    """Entries that are about what the instruction says, with their ``S_sem``.

    Raises:
        InstructionError: No entry is. The error lists the instructions the memory knows.
    """
    return candidates_for(parse_instruction(instruction), instruction, entries)


def candidates_for(
    sub_tasks: Sequence[SubTask], instruction: str, entries: Sequence[MemoryEntry]
) -> list[tuple[MemoryEntry, float]]:
    """Entries that are about some sub-tasks, with their ``S_sem``; the instruction only names them in errors.

    Raises:
        InstructionError: No entry is. The error lists the instructions the memory knows.
    """
    scored = [(entry, semantic_score(sub_tasks, entry.key.sub_tasks)) for entry in entries]
    close = [(entry, score) for entry, score in scored if score >= MIN_SEMANTIC]
    if not close:
        known = "; ".join(sorted({entry.language for entry in entries})) or "nothing yet"
        raise InstructionError(
            f"the memory holds no experience for the instruction {instruction!r}; it knows: {known}. "
            "Record demonstrations of it and train again, or use one of these instructions"
        )
    return close


def semantic_score(asked: Sequence[SubTask], known: Sequence[SubTask]) -> float:
    """``S_sem`` in 0..1: how many task elements agree, sub-task by sub-task, in order."""
    if len(asked) != len(known):
        return 0.0
    scores = [_sub_task_score(a, k) for a, k in zip(asked, known, strict=True)]
    return min(scores) if scores else 0.0


def _sub_task_score(asked: SubTask, known: SubTask) -> float:
    if asked.operation != known.operation:
        return 0.0
    terms = [
        (0.3, _names_agree(asked.target, known.target)),
        (0.3, _names_agree(asked.landmark, known.landmark)),
        (0.3, _names_agree(asked.part, known.part)),
        (0.1, float(asked.relation == known.relation)),
    ]
    return 0.0 if min(terms[0][1], terms[1][1]) == 0.0 else sum(weight * value for weight, value in terms)


def _names_agree(asked: str, known: str) -> float:
    """1 for the same words, less for a shorter or longer name of the same thing ("bottle"), 0 for another."""
    if asked == known:
        return 1.0
    a, k = asked.split(), known.split()
    shared = len(set(a) & set(k))
    return 0.8 if a and k and shared == min(len(set(a)), len(set(k))) else 0.0


def retrieve(
    candidates: Sequence[tuple[MemoryEntry, float]],
    geometric: Callable[[MemoryEntry], float],
    weights: ScoreWeights,
) -> list[Scored]:
    """Rank entries by ``lambda_s S_sem + lambda_g S_geo + lambda_r r``, best first.

    Args:
        candidates: Entries with their semantic score.
        geometric: ``S_geo`` in 0..1 of an entry in the present scene; 0 if it cannot be executed there,
            because an object was not found or its key poses, carried over, fail the checks.
        weights: The three lambdas.
    """
    ranked: list[Scored] = []
    for entry, semantic in candidates:
        geometry = geometric(entry)
        total = weights.semantic * semantic + weights.geometric * geometry + weights.quality * entry.quality
        ranked.append(Scored(entry, semantic, geometry, entry.quality, total))
    # Usable entries first whatever the weights: an infeasible one cannot be executed.
    return sorted(ranked, key=lambda scored: (scored.geometric == 0.0, -scored.total))
