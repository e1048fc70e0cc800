"""Success from pixels of the three ways to follow key poses, on the same policy and the same episodes."""

from benchmarks.common import EVALUATION_SEED, dataset, evaluation, policy, success, write

from lerobot_openspm.cli.pipeline import collect_dataset


def main() -> dict:
    """Evaluate, write and return the result."""
    checkpoint, train_s = policy()
    runs = {
        "closed_loop_trc": success(evaluation("eval_20", checkpoint)),
        "closed_loop": success(evaluation("eval_closed_loop", checkpoint, "--policy.execution=closed_loop")),
        "open_loop": success(evaluation("eval_open_loop", checkpoint, "--policy.execution=open_loop")),
    }
    collected = collect_dataset(dataset(), 10)
    expert_steps = round(collected["frames"] / collected["episodes"], 1)
    return write(
        "execution", {"seed": EVALUATION_SEED, "train_s": train_s, "expert_steps": expert_steps, "runs": runs}
    )


if __name__ == "__main__":
    main()
