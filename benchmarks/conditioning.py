"""The flow model told the poses in the world, as in the paper, against those in the frame of the target."""

from benchmarks.common import EVALUATION_SEED, evaluation, policy, success, write


def main() -> dict:
    """Train and evaluate both, write and return the result."""
    equivariant, _ = policy()
    paper, _ = policy("train_paper", "--policy.conditioning=paper")
    return write(
        "conditioning",
        {
            "seed": EVALUATION_SEED,
            "equivariant": success(evaluation("eval_20", equivariant)),
            "paper": success(evaluation("eval_paper", paper)),
        },
    )


if __name__ == "__main__":
    main()
