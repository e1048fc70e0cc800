"""Which seeds belong to what: evaluation, demonstrations and tuning never share an initial state."""

EVALUATION_SEED_START = 0
DEMO_SEED_START = 1_000_000
TUNING_SEED_START = 2_000_000
SEED_END = 3_000_000

EVALUATION_SEEDS = range(EVALUATION_SEED_START, DEMO_SEED_START)
DEMO_SEEDS = range(DEMO_SEED_START, TUNING_SEED_START)
TUNING_SEEDS = range(TUNING_SEED_START, SEED_END)


def require_demo_seeds(first: int, count: int) -> None:
    """Refuse `count` seeds from `first` on unless all of them are reserved for demonstrations.

    Raises:
        ValueError: A seed would be an evaluation or a tuning seed.
    """
    if first not in DEMO_SEEDS or first + count > DEMO_SEEDS.stop:
        raise ValueError(
            f"demonstration seeds must lie in [{DEMO_SEEDS.start}, {DEMO_SEEDS.stop}), "
            f"got {first} to {first + count - 1}; "
            f"pass --seed={DEMO_SEED_START} or more, since lower seeds are kept for evaluation"
        )
