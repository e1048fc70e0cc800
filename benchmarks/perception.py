"""Error of the object poses against the simulator, on scenes that no demonstration showed."""

import json

import numpy as np
from common import EVALUATION_SEED, dataset, policy, write
from lerobot.datasets import LeRobotDatasetMetadata
from tqdm import trange

from lerobot_openspm.cli.pipeline import REPO_ID
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.tabletop_env import TabletopEnv
from lerobot_openspm.experience import load_experience
from lerobot_openspm.geometry import se3
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

    A learned object's frame stands in a fixed but arbitrary place on the object. That one rigid offset is
    fitted on the demonstrations, against the simulator, and errors are what remains on unseen scenes. Means
    are over the scenes in which the object was found; the others are counted as not found.
    """
    checkpoint, _ = policy()
    experience = load_experience(checkpoint)
    offsets = {name: _offset(experience, name) for name in experience.objects}
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
                T_error = se3.inverse(truth[name]) @ estimate.T_world_obj @ se3.inverse(offsets[name])
                errors[name].append(_error(T_error, TRUE_PERIODS[name]))
            else:
                errors[name].append((np.nan, np.nan))
    rows = {name: _summary(np.array(found), TRUE_PERIODS[name]) for name, found in errors.items()}
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


def _offset(experience, name: str) -> np.ndarray:
    """The model's frame in the simulator's, ``T_sim_obj``, as the median over the demonstrations."""
    config = OpenSPMConfig(device="cpu", push_to_hub=False)
    demonstrations = open_demonstrations(LeRobotDatasetMetadata(REPO_ID, root=dataset()), config)
    period, relative = experience.objects[name].yaw_period, []
    for entry in experience.entries:
        if name in entry.layout:
            episode = demonstrations.episodes([int(entry.source.rsplit("#", 1)[1])])[0]
            poses = demonstrations.simulator_poses(episode, 0)
            truth = name_simulator_poses(poses, [name], experience.objects)[name]
            equivalents = [se3.inverse(truth) @ T for T in se3.yaw_equivalents(entry.layout[name], period)]
            relative.append(min(equivalents, key=lambda T: abs(float(se3.yaw_of(T)))))
    relative = np.stack(relative)
    return se3.from_yaw(np.median(relative[:, :3, 3], axis=0), np.median(se3.yaw_of(relative)))


def _error(T_error: np.ndarray, period: float) -> tuple[float, float]:
    """Distance in metres, and yaw in radians up to the object's symmetry (NaN for round ones)."""
    yaw = float(abs(se3.wrap_angle(se3.yaw_of(T_error), period))) if period > 0 else np.nan
    return float(np.linalg.norm(T_error[:3, 3])), yaw


def _summary(errors: np.ndarray, period: float) -> dict:
    metres, radians = errors.T
    return {
        "n": len(errors),
        "not_found": int(np.isnan(metres).sum()),
        "position_mm_mean": round(1000 * float(np.nanmean(metres)), 2),
        "position_mm_p95": round(1000 * float(np.nanpercentile(metres, 95)), 2),
        "yaw_deg_mean": round(float(np.rad2deg(np.nanmean(radians))), 2) if period > 0 else None,
    }


if __name__ == "__main__":
    print(json.dumps(main()))
