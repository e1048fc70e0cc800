"""Error of the object poses with true masks from the simulator: boxes against shapes, on unseen scenes.

Learned from the demonstrations' first frames, whose masks are rendered again from their seeds. Scenes are
drawn from tuning seeds: these figures chose the method.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from benchmarks.common import dataset, write
from benchmarks.object_frames import error, summary, upright
from benchmarks.perception import TRUE_PERIODS
from lerobot.datasets import LeRobotDatasetMetadata
from tqdm import tqdm

from lerobot_openspm.cli.pipeline import REPO_ID
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.calibration import calibration_document
from lerobot_openspm.envs.scene import OBJECT_LABELS
from lerobot_openspm.envs.seeds import TUNING_SEED_START
from lerobot_openspm.envs.tabletop_env import TabletopEnv
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera, cameras_from_dict
from lerobot_openspm.mining.mine import learn_scenes, mine_key_poses, name_simulator_poses
from lerobot_openspm.mining.signals import observe_robot
from lerobot_openspm.perception.learning import Shape, learn_objects
from lerobot_openspm.perception.localise import localise_all
from lerobot_openspm.perception.model import KnownObject
from lerobot_openspm.perception.segmentation.given import GivenSegmenter
from lerobot_openspm.perception.types import Scene, View
from lerobot_openspm.training import open_demonstrations

FIRST_SEED, SCENES = TUNING_SEED_START + 100_000, 50
PHRASES = {"box": "cream cheese box", "bottle": "wine bottle"}
SEGMENTER = GivenSegmenter({PHRASES.get(name, name): number for name, number in OBJECT_LABELS.items()})
Truth = dict[str, np.ndarray]


def rendered(seeds: Sequence[int], cameras: Mapping[str, Camera]) -> Iterator[tuple[dict[str, View], Truth]]:
    """Views with labels of the initial states of seeds, and the true poses by phrase."""
    env = TabletopEnv(masks=True)
    for seed in tqdm(seeds, desc="Scenes"):
        observation, _ = env.reset(seed=seed)
        views = {}
        for key, camera in cameras.items():
            name = key.rsplit(".", 1)[1]
            image, labels = observation["pixels"][name], observation[f"masks.{name}"][0]
            views[key] = View(image, camera, camera.T_world_cam(env.ee_pose()), None, labels)
        yield views, name_simulator_poses(env.object_poses(), list(TRUE_PERIODS), {})
    env.close()


def labelled_scenes(cameras: Mapping[str, Camera]) -> list[tuple[Scene, Truth]]:
    """What learning sees of the demonstrations, with true masks in the first frames."""
    root = dataset()
    config = OpenSPMConfig(device="cpu", push_to_hub=False)
    demonstrations = open_demonstrations(LeRobotDatasetMetadata(REPO_ID, root=root), config)
    robot = observe_robot(demonstrations.episodes(), None)
    mined = mine_key_poses(demonstrations, robot).mined
    scenes = learn_scenes(demonstrations, mined, cameras)
    recorded = json.loads((root / "meta/openspm_collect.json").read_text())["episodes"]
    again = rendered([recorded[item.episode.index]["seed"] for item in mined], cameras)
    return [(replace(s, views=views), truth) for s, (views, truth) in zip(scenes, again, strict=True)]


def offsets(models: Mapping[str, KnownObject], scenes: Sequence[tuple[Scene, Truth]]) -> Truth:
    """Each model's frame in the simulator's, as the median over the demonstrations."""
    relative: dict[str, list[np.ndarray]] = {name: [] for name in models}
    for scene, truth in scenes[::3]:
        for name, found in localise_all(scene.views, models, SEGMENTER).items():
            T = se3.inverse(upright(truth[name])) @ found.T_world_obj
            turns = se3.yaw_equivalents(T, TRUE_PERIODS[name])
            relative[name].append(min(turns, key=lambda one: abs(float(se3.yaw_of(one)))))
    middle = {name: np.median(np.stack(ones)[:, :3, 3], axis=0) for name, ones in relative.items()}
    yaws = {name: np.median(se3.yaw_of(np.stack(ones))) for name, ones in relative.items()}
    return {
        name: se3.from_yaw(middle[name] if TRUE_PERIODS[name] else middle[name] * [0, 0, 1], yaws[name])
        for name in models
    }


def measure(shape: Shape, scenes: Sequence[tuple[Scene, Truth]], cameras: Mapping[str, Camera]) -> dict:
    """Errors per object of one kind of model."""
    models = learn_objects(
        [scene for scene, _ in scenes], np.random.default_rng(0), segmenter=SEGMENTER, shape_source=shape
    )
    T_sim_obj, errors = offsets(models, scenes), {name: [] for name in models}
    for views, truth in rendered(range(FIRST_SEED, FIRST_SEED + SCENES), cameras):
        for name, found in localise_all(views, models, SEGMENTER).items():
            own = error(truth[name], found.T_world_obj, T_sim_obj[name], TRUE_PERIODS[name])
            errors[name].append(own if found.status == "found" else (np.nan, np.nan))
    return {name: summary(np.array(rows), TRUE_PERIODS[name]) for name, rows in errors.items()}


def main() -> dict:
    """Measure both kinds of models, write and return the result."""
    cameras = cameras_from_dict(calibration_document(256, 256), "tabletop")
    scenes = labelled_scenes(cameras)
    shapes: tuple[Shape, ...] = ("box", "demonstrations")
    return write(
        "masks",
        {"seed": FIRST_SEED, "n": SCENES, **{shape: measure(shape, scenes, cameras) for shape in shapes}},
    )


if __name__ == "__main__":
    print(json.dumps(main()))
