"""Train on recorded demonstrations, then let the policy act in scenes it has not seen.

    python examples/02_train_and_evaluate.py

Both steps are LeRobot's own command lines, which find OpenSPM by themselves once it is installed. Training
mines the memory first, and then fits the small model that moves the hand from one key pose to the next.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from lerobot_openspm.envs.collection import CollectConfig, SimulatorConfig, collect

REPOSITORY = Path(__file__).parents[1]


def run(command: str, *options: str) -> None:
    """Run one of LeRobot's commands, the one installed beside this Python."""
    print(command, *options, sep=" \\\n    ")
    subprocess.run([Path(sys.executable).with_name(command), *options], check=True, cwd=REPOSITORY)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--task", default="turn_on_stove", help="the task to demonstrate and to evaluate")
    parser.add_argument("--demonstrations", type=int, default=5)
    parser.add_argument("--steps", type=int, default=600, help="training steps")
    parser.add_argument("--episodes", type=int, default=4, help="evaluation episodes")
    parser.add_argument("--max-length", type=int, default=300, help="longest evaluation episode, in steps")
    parser.add_argument("--image-size", type=int, default=256, help="pixels in evaluation")
    parser.add_argument("--dataset", type=Path, help="a recorded dataset, instead of recording one")
    parser.add_argument("--output", type=Path, default=Path("outputs/examples/02"))
    options = parser.parse_args()
    output = options.output.resolve()
    if (output / "train").exists():
        sys.exit(f"{output / 'train'} exists; remove it or choose another --output")

    dataset = (options.dataset or output / "dataset").resolve()
    if options.dataset is None:
        collect(
            CollectConfig(
                SimulatorConfig(task=options.task), episodes=options.demonstrations, root=str(dataset)
            )
        )

    # The ready-made configuration names the policy, the cameras and sensible settings; the rest is ours.
    run(
        "lerobot-train", "--config_path=configs/openspm_tabletop_train.yaml", f"--dataset.root={dataset}",
        f"--output_dir={output / 'train'}", f"--steps={options.steps}", f"--save_freq={options.steps}",
        "--num_workers=0",
    )  # fmt: skip

    # A checkpoint is a folder: weights, memory, calibration. Scenes are drawn from seeds that no
    # demonstration was recorded from, and the policy sees cameras, state and instruction only.
    checkpoint, log = output / "train/checkpoints/last/pretrained_model", output / "episodes.jsonl"
    run(
        "lerobot-eval", f"--policy.path={checkpoint}", "--policy.device=cpu", "--env.type=openspm_tabletop",
        f"--env.task={options.task}", f"--env.episode_log={log}",
        f"--env.episode_length={options.max_length}",
        f"--env.observation_height={options.image_size}", f"--env.observation_width={options.image_size}",
        f"--eval.n_episodes={options.episodes}", f"--eval.batch_size={min(options.episodes, 2)}",
        f"--output_dir={output / 'eval'}",
    )  # fmt: skip

    for line in log.read_text().splitlines():
        episode = json.loads(line)
        print(f"seed {episode['seed']}: {episode['status']} after {episode['steps']} steps")
    print(f"videos in {output / 'eval'}")


if __name__ == "__main__":
    main()
