"""The paper's reliability ``r`` of an entry, and how trials at deployment change it."""

from __future__ import annotations

from dataclasses import replace

from lerobot_openspm.memory.entry import MemoryEntry

# What the demonstrations tell, their agreement and how firmly they held, weighs as much as this many trials:
# after one failure of a good entry, others of its task are tried first; after five trials these weigh more.
PRIOR_TRIALS = 5


def with_success(entry: MemoryEntry, success: bool) -> MemoryEntry:
    """An entry after it was acted by once more.

    ``r`` is the mean of a Beta distribution whose prior has what the demonstrations tell as its mean and
    :data:`PRIOR_TRIALS` as its weight; each trial is one more observation.
    """
    weight = PRIOR_TRIALS + entry.trials
    quality = (entry.quality * weight + success) / (weight + 1)
    return replace(entry, quality=quality, trials=entry.trials + 1, successes=entry.successes + bool(success))


def prior_quality(entry: MemoryEntry) -> float:
    """What ``r`` was before any trial: what the demonstrations tell."""
    weight = PRIOR_TRIALS + entry.trials
    return min(max((entry.quality * weight - entry.successes) / PRIOR_TRIALS, 0.0), 1.0)


def pooled_quality(prior: float, trials: int, successes: int) -> float:
    """``r`` of a prior and all trials since."""
    return (prior * PRIOR_TRIALS + successes) / (PRIOR_TRIALS + trials)
