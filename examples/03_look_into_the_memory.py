"""Ask a memory what it would do: which demonstration it recalls for an instruction, and where the hand goes.

    python examples/01_record_and_mine.py            # makes the memory that this example looks into
    python examples/03_look_into_the_memory.py --instruction="put the bowl on the plate"

It prints the scores of the remembered demonstrations in a new scene, and draws the key poses of the best one,
carried over to where the objects are now, into the camera image.
"""

import argparse
from pathlib import Path

import torch

from lerobot_openspm.cli.drawing import draw_key_poses, save_png
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.planning import PlanningContext
from lerobot_openspm.control.transfer import transfer
from lerobot_openspm.envs.tabletop.env import ACTION_NAMES, STATE_NAMES, TabletopEnv
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.perception.observation import split_batch
from lerobot_openspm.perception.pipeline import Perception

CAMERA = "observation.images.front"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--memory", type=Path, default=Path("outputs/examples/01/memory"))
    parser.add_argument("--instruction", default="put the bowl on the plate")
    parser.add_argument("--seed", type=int, default=2_000_000, help="scene to look at")
    parser.add_argument("--output", type=Path, default=Path("outputs/examples/03"))
    options = parser.parse_args()

    # 1. A new scene, and what the cameras and the hand say about it.
    env = TabletopEnv("bowl_on_plate")
    seen, _ = env.reset(seed=options.seed)
    env.close()
    images = {f"observation.images.{name}": torch.as_tensor(image) for name, image in seen["pixels"].items()}
    batch = {key: image.permute(2, 0, 1)[None] for key, image in images.items()}
    batch |= {"observation.state": torch.as_tensor(seen["agent_pos"])[None], "task": [options.instruction]}
    config = OpenSPMConfig(state_layout=list(STATE_NAMES), action_layout=list(ACTION_NAMES), device="cpu")
    (observation,) = split_batch(batch, config.layouts()[0])

    # 2. Plan: find the objects in the images, rank the entries, carry the best one over.
    memory = read_memory(options.memory)
    context = PlanningContext(memory.entries, memory.yaw_periods, memory.robot)
    controller = EpisodeController(context, options.instruction, observation.fingerprint(), noise_seed=0)
    perception = Perception(memory, config.hand_radius_m)
    look = controller.advance(observation.hand)
    while look is not None:
        seen = perception.detect(observation, look.names, look.expected, look.time_s)
        look = controller.take_in(look, seen, observation.hand)

    state = controller.state
    print(f"{options.instruction!r}: {state.status.name.lower()}")
    poses = controller.scene.tracker.poses(observation.hand.T_world_ee)
    for name, T_world_obj in poses.items():
        print(f"  the {name} is at {T_world_obj[:3, 3].round(3).tolist()} m")
    print("  recalled              semantics  geometry  quality   score")
    for item in state.ranked:
        scores = (item.semantic, item.geometric, item.quality, item.total)
        print(f"  {item.entry.source.split('/')[-1]:20s}", *(f"{score:9.2f}" for score in scores))

    # 3. Draw where the hand is to go.
    best = state.ranked[0].entry
    if any(name not in poses for name in best.objects):
        raise SystemExit("not all of its objects were found in this scene; try another --seed")
    targets = transfer(best, poses, memory.yaw_periods, observation.hand.T_world_ee)
    view = observation.views(memory.cameras)[CAMERA]
    picture = draw_key_poses(view, [t.T_world_ee for t in targets], [t.key_pose.phase for t in targets])
    save_png(picture, options.output / "key_poses.png")
    print(f"  drawn into {options.output / 'key_poses.png'}")


if __name__ == "__main__":
    main()
