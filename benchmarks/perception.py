"""Error of the object poses against the simulator, on scenes that no demonstration showed."""

import json

import numpy as np
from benchmarks.common import EVALUATION_SEED, dataset, policy, write
from lerobot.datasets import LeRobotDatasetMetadata
from tqdm import trange

from lerobot_openspm.bench.object_frames import error, offset, summary
from lerobot_openspm.cli.pipeline import REPO_ID
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.tabletop_env import TabletopEnv
from lerobot_openspm.experience import load_experience
from lerobot_openspm.mining.mine import name_simulator_poses
from lerobot_openspm.perception.localise import localise, prepare
from lerobot_openspm.perception.types import View
from lerobot_openspm.training import open_demonstrations

SCENES = 200
# By which angle each object truly turns into itself; what was learned may differ and is then an error.
TRUE_PERIODS = {
    "bowl": 0.0,
    "plate": 0.0,
    "wine bottle": 0.0,
    "cream cheese box": np.pi,
    "rack": np.pi,
    "cabinet": 2 * np.pi,
    "stove": 2 * np.pi,
}


def main() -> dict:
    """Localise every object in every scene, write and return the result.

    Means are over the scenes in which the object was found; the others are counted as not found.
    """
    checkpoint, _ = policy()
    experience = load_experience(checkpoint)
    config = OpenSPMConfig(device="cpu", push_to_hub=False)
    demonstrations = open_demonstrations(LeRobotDatasetMetadata(REPO_ID, root=dataset()), config)
    offsets = {name: offset(experience, name, demonstrations) for name in experience.objects}
    env = TabletopEnv(task="bowl_on_plate")
    errors = {name: [] for name in experience.objects}
    for scene in trange(SCENES, desc="Scenes"):
        observation, _ = env.reset(seed=EVALUATION_SEED + scene)
        views = {}
        for key, camera in experience.cameras.items():
            image = observation["pixels"][key.rsplit(".", 1)[1]]
            views[key] = prepare(View(image, camera, camera.T_world_cam(env.ee_pose())))
        truth = name_simulator_poses(env.object_poses(), list(errors), experience.objects)
        for name, model in experience.objects.items():
            estimate = localise(views, model)
            if estimate.status == "found":
                T_world_obj = estimate.T_world_obj
                errors[name].append(error(truth[name], T_world_obj, offsets[name], TRUE_PERIODS[name]))
            else:
                errors[name].append((np.nan, np.nan))
    rows = {name: summary(np.array(found), TRUE_PERIODS[name]) for name, found in errors.items()}
    everything = np.concatenate([np.array(found)[:, 0] for found in errors.values()])
    yaws = [row["yaw_deg_mean"] for row in rows.values() if row["yaw_deg_mean"] is not None]
    return write(
        "perception",
        {
            "seed": EVALUATION_SEED,
            "n": SCENES,
            "position_mm_mean": round(1000 * float(np.nanmean(everything)), 2),
            "position_mm_p95": round(1000 * float(np.nanpercentile(everything, 95)), 2),
            "yaw_deg_mean": round(float(np.mean(yaws)), 2),
            "objects": rows,
            "learned_yaw_periods_deg": {
                name: round(float(np.rad2deg(period))) for name, period in experience.yaw_periods.items()
            },
        },
    )


if __name__ == "__main__":
    print(json.dumps(main()))
