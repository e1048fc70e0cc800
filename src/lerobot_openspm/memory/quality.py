"""The paper's reliability ``r`` of an entry, and how trials at deployment change it."""

from __future__ import annotations

from dataclasses import replace

from lerobot_openspm.memory.entry import MemoryEntry

# The demonstrations' agreement weighs as much as this many trials: after one failure of a good entry, others
# of its task are tried first; after five trials these weigh more.
PRIOR_TRIALS = 5


def with_success(entry: MemoryEntry, success: bool) -> MemoryEntry:
    """An entry after it was acted by once more.

    ``r`` is the mean of a Beta distribution whose prior has the demonstrations' agreement as its mean and
    :data:`PRIOR_TRIALS` as its weight; each trial is one more observation.
    """
    weight = PRIOR_TRIALS + entry.trials
    quality = (entry.quality * weight + success) / (weight + 1)
    return replace(entry, quality=quality, trials=entry.trials + 1, successes=entry.successes + bool(success))


def prior_quality(entry: MemoryEntry) -> float:
    """What ``r`` was before any trial: how well the demonstration agrees with others."""
    weight = PRIOR_TRIALS + entry.trials
    return min(max((entry.quality * weight - entry.successes) / PRIOR_TRIALS, 0.0), 1.0)


def pooled_quality(prior: float, trials: int, successes: int) -> float:
    """``r`` of a prior and all trials since."""
    return (prior * PRIOR_TRIALS + successes) / (PRIOR_TRIALS + trials)
