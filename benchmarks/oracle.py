"""Success with the simulator's object poses in place of perception: what is lost to perception (oracle)."""

from benchmarks.common import EVALUATION_SEED, evaluation, policy, success, write


def main() -> dict:
    """Train and evaluate with true poses, write and return the result."""
    checkpoint, _ = policy("train_oracle", "--policy.perception=oracle")
    return write(
        "oracle",
        {
            "seed": EVALUATION_SEED,
            "oracle": success(evaluation("eval_oracle", checkpoint, "--env.object_poses=true")),
        },
    )


if __name__ == "__main__":
    main()
