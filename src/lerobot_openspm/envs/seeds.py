"""Which seeds belong to what: evaluation, demonstrations and tuning never share an initial state."""

DEMO_SEED_START = 1_000_000
TUNING_SEED_START = 2_000_000

DEMO_SEEDS = range(DEMO_SEED_START, TUNING_SEED_START)


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
