"""LIBERO's simulator as the scripted experts see it: true poses, the hand, and one step at a time.

World frame: LIBERO's, z up, the robot's base behind the table at negative x. The `ee` frame has its origin at
the grip site between the fingertips and the axes of the hand body, exactly as `observation.state` tells it: z
points out of the hand (down at home), and the fingers open along its y axis.
"""

# mujoco ships no stubs for its compiled part.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from lerobot.envs.utils import preprocess_observation
from lerobot.processor.env_processor import LiberoProcessorStep

from lerobot_openspm.envs.libero.rendering import Renderer
from lerobot_openspm.geometry.se3 import transform

SUITE = "libero_goal"
HAND_BODY, GRIP_SITE = "robot0_right_hand", "gripper0_grip_site"
# LIBERO's cameras, by the names that LeRobot gives their images.
CAMERAS = {"image": "agentview", "image2": "robot0_eye_in_hand"}
CAMERA_MOUNTS: dict[str, Literal["world", "ee"]] = {"image": "world", "image2": "ee"}
# Everything in a suite's scenes, in the order of its recorded pose vectors: LIBERO's name by one of our own,
# in the words that instructions have for it. Of two of a kind, the first is what tasks are about.
OBJECTS = {
    "libero_goal": {
        "bowl": "akita_black_bowl_1",
        "cheese": "cream_cheese_1",
        "bottle": "wine_bottle_1",
        "plate": "plate_1",
        "cabinet": "wooden_cabinet_1",
        "stove": "flat_stove_1",
        "rack": "wine_rack_1",
    },
    "libero_spatial": {
        "bowl": "akita_black_bowl_1",
        "bowl_2": "akita_black_bowl_2",
        "cookie_box": "cookies_1",
        "ramekin": "glazed_rim_porcelain_ramekin_1",
        "plate": "plate_1",
        "cabinet": "wooden_cabinet_1",
        "stove": "flat_stove_1",
    },
    # Every scene holds seven of these.
    "libero_object": {
        name: f"{name}_1"
        for name in (
            "alphabet_soup", "cream_cheese", "salad_dressing", "bbq_sauce", "ketchup", "tomato_sauce",
            "butter", "milk", "chocolate_pudding", "orange_juice", "basket",
        )
    },
    # Every scene holds three to eight of these.
    "libero_10": {
        **{
            name: f"{name}_1"
            for name in (
                "alphabet_soup", "cream_cheese", "tomato_sauce", "ketchup", "orange_juice", "milk", "butter",
                "basket", "chocolate_pudding", "moka_pot", "microwave", "plate",
            )
        },
        "moka_pot_2": "moka_pot_2",
        "plate_2": "plate_2",
        "white_mug": "porcelain_mug_1",
        "yellow_and_white_mug": "white_yellow_mug_1",
        "red_mug": "red_coffee_mug_1",
        "book": "black_book_1",
        "caddy": "desk_caddy_1",
        "stove": "flat_stove_1",
        "pan": "chefmate_8_frypan_1",
        "bowl": "akita_black_bowl_1",
        "bottle": "wine_bottle_1",
        "cabinet": "white_cabinet_1",
        "rack": "wine_rack_1",
    },
}  # fmt: skip
# As many as LeRobot gives an episode.
MAX_STEPS = {"libero_goal": 300, "libero_spatial": 280, "libero_object": 280, "libero_10": 520}
# Objects float or overlap a little after a reset; LeRobot's environment waits as long.
SETTLING_STEPS = 10
# Some of libero_10's fall from as high as a metre: in a drawn scene it is waited until nothing is faster than
# this, metres a second, for so many steps at most.
STILL_M_S, MOST_SETTLING_STEPS = 0.01, 60
DO_NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)


@functools.cache
def tasks(suite: str = SUITE) -> dict[str, str]:
    """Names of a suite's tasks with their instructions, in LIBERO's order.

    Args:
        suite: One of `OBJECTS`.

    Raises:
        ValueError: LIBERO is not installed.
        RuntimeError: LIBERO was never set up, and there is nobody to answer its question.
    """
    try:
        from libero.libero import benchmark  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError(
            f"env.type=libero needs LIBERO ({error}); install it with: pip install '.[libero]', from a "
            "checkout, or with: make libero-setup"
        ) from error
    except EOFError as error:
        raise RuntimeError(
            "LIBERO asks once, when it is first imported, whether its datasets go to a folder of yours, and "
            "there is no terminal to answer on; answer for it with: python scripts/libero_assets.py, from a "
            "checkout, or with: echo N | python -c 'import libero.libero'"
        ) from error
    return {task.name: task.language for task in benchmark.get_benchmark_dict()[suite]().tasks}


def suite_of(task: str) -> str:
    """The suite that a task belongs to; no two have a task of the same name.

    Raises:
        ValueError: It is in none of `OBJECTS`, or LIBERO is not installed.
    """
    for suite in OBJECTS:
        if task in tasks(suite):
            return suite
    known = "; ".join(f"{suite}: {', '.join(tasks(suite))}" for suite in OBJECTS)
    raise ValueError(f"LIBERO has no task {task!r}, expected one of {known}")


def task_file(task: str) -> Path:
    """LIBERO's own description of a task in :func:`tasks`."""
    from libero.libero import get_libero_path  # pyright: ignore[reportMissingImports]

    return Path(get_libero_path("bddl_files")) / suite_of(task) / f"{task}.bddl"


def scene_kind(task: str) -> str:
    """LIBERO's name of the kind of a task's scenes; in all of one kind cameras and robot stand alike."""
    return task_file(task).read_text().partition("(problem ")[2].partition(")")[0]


class LiberoSimulator:
    """One LIBERO task.

    Args:
        task: A name in :func:`tasks` of any suite in `OBJECTS`.
        image_size: Height and width of the images in pixels, which are drawn when asked for; None draws none.
        file: A variant of the task, which says what stands where and what is asked; LIBERO's own by default.
    """

    def __init__(self, task: str, image_size: int | None = None, file: Path | None = None) -> None:
        self.suite = suite_of(task)
        from libero.libero.envs.env_wrapper import ControlEnv  # pyright: ignore[reportMissingImports]

        self._image_size = image_size
        self._renderer: Renderer | None = None
        self._env: Any = ControlEnv(
            bddl_file_name=os.fspath(file or task_file(task)),
            use_camera_obs=False,
            has_offscreen_renderer=False,
        )
        self.task, self.max_steps = task, MAX_STEPS[self.suite]
        self.instruction = tasks(self.suite)[task] if file is None else str(self._env.language_instruction)
        self._observation: dict[str, Any] = {}
        # The scene as it was when the last observation was sampled, MuJoCo's data.
        self._sampled: Any = None

    def reset(self, seed: int) -> None:
        """Draw a scene and let it settle until it is still."""
        self._draw(seed)
        self._settle()
        for _ in range(MOST_SETTLING_STEPS):
            if self._is_still():
                return
            self.step(np.array(DO_NOTHING))

    def reset_to(self, seed: int, state: np.ndarray) -> None:
        """Start from one of the benchmark's evaluation states, as LeRobot does. For evaluation only.

        Args:
            seed: Draws what a state does not hold: where the fixtures stand.
            state: LIBERO's flattened state.
        """
        self._draw(seed)
        self._observation = self._env.set_init_state(state)
        self._settle()

    def _draw(self, seed: int) -> None:
        # LIBERO draws its scenes from NumPy's global generator; there is no other way to seed them.
        self._env.seed(seed)
        self._observation = self._env.reset()
        if self._image_size is not None:
            self._keep_what_is_sampled()

    def _keep_what_is_sampled(self) -> None:
        """Keep the scene of every observation, so that its images can be made later.

        robosuite samples observations somewhere within a control step, not at its end.
        """
        import mujoco

        model, data = self.sim.model._model, self.sim.data._data
        self._sampled = mujoco.MjData(model)
        observable = self._env.env._observables["robot0_eef_pos"]
        sense = observable._sensor

        @functools.wraps(sense)
        def sense_and_keep(cache: dict[str, Any]) -> Any:
            mujoco.mj_copyData(self._sampled, model, data)
            return sense(cache)

        self._env.env.modify_observable("robot0_eef_pos", "sensor", sense_and_keep)

    def _settle(self) -> None:
        for _ in range(SETTLING_STEPS):
            self.step(np.array(DO_NOTHING))

    def _is_still(self) -> bool:
        model, data = self.sim.model._model, self.sim.data._data
        bodies = [model.body(thing.root_body).id for thing in self._things().values()]
        return bool(np.linalg.norm(data.cvel[bodies, 3:], axis=1).max() < STILL_M_S)

    def step(self, action: np.ndarray) -> bool:
        """Apply a 7-D action for one step of 20 Hz. Returns whether LIBERO's goal holds now."""
        self._observation, _, _, _ = self._env.step(action)
        return bool(self._env.check_success())

    @property
    def sim(self) -> Any:
        """Robosuite's simulation, with MuJoCo's model and data."""
        return self._env.sim

    def ee_pose(self) -> np.ndarray:
        """``T_world_ee``, (4, 4)."""
        data = self.sim.data
        return transform(data.get_body_xmat(HAND_BODY), data.get_site_xpos(GRIP_SITE))

    def finger_positions(self) -> np.ndarray:
        """Positions of the two fingers, (2,), metres, of opposite signs as LIBERO gives them."""
        return np.asarray(self._observation["robot0_gripper_qpos"], float)

    def state(self) -> np.ndarray:
        """``observation.state`` (8,): position, axis-angle, fingers, made by LeRobot's own processor step."""
        seen = self._observation
        raw = {
            "eef": {"pos": seen["robot0_eef_pos"], "quat": seen["robot0_eef_quat"]},
            "gripper": {"qpos": seen["robot0_gripper_qpos"]},
        }
        nested: Any = {"robot_state": _batched(raw)}
        batch = preprocess_observation(nested)
        return LiberoProcessorStep().observation(batch)["observation.state"][0].numpy()

    def images(self) -> dict[str, np.ndarray]:
        """The cameras' images (H, W, 3) uint8 by LeRobot's names, turned as LeRobot turns them."""
        return {name: self.image(name) for name in CAMERAS}

    def image(self, name: str) -> np.ndarray:
        """One camera's image (H, W, 3) uint8, turned as LeRobot turns it.

        Raises:
            ValueError: The simulator was made without images.
        """
        if self._image_size is None:
            raise ValueError("this simulator was made without images; pass image_size")
        return self._drawn(self._sampled, name, self._image_size)

    def render(self, name: str, size: int) -> np.ndarray:
        """One camera's image of the present scene (size, size, 3) uint8, turned as LeRobot turns it."""
        return self._drawn(self.sim.data._data, name, size)

    def _drawn(self, data: Any, name: str, size: int) -> np.ndarray:
        if self._renderer is None:
            self._renderer = Renderer()
        image = self._renderer.image(self.sim.model._model, data, CAMERAS[name], size)
        return np.ascontiguousarray(image[::-1, ::-1])

    def object_poses(self) -> dict[str, np.ndarray]:
        """True ``T_world_obj`` (4, 4) of those of the suite's `OBJECTS` that the scene holds."""
        return {name: self.body_pose(one.root_body) for name, one in self._things().items()}

    def root_body(self, name: str) -> str:
        """MuJoCo's name of the body of one of the suite's `OBJECTS`."""
        return self._things()[name].root_body

    def _things(self) -> dict[str, Any]:
        """Those of the suite's `OBJECTS` that the scene holds; a variant of a task may hold another bowl."""
        held = {**self._env.env.objects_dict, **self._env.env.fixtures_dict}
        found = {name: held[thing] for name, thing in OBJECTS[self.suite].items() if thing in held}
        for name in [name for name in OBJECTS[self.suite] if name not in found]:
            like = [thing for thing in held if thing.endswith(f"_{name}_1")]
            if like:
                found[name] = held[like[0]]
        return {name: found[name] for name in OBJECTS[self.suite] if name in found}

    def body_pose(self, name: str) -> np.ndarray:
        """``T_world_body`` (4, 4) of any body of the MuJoCo model."""
        return transform(self.sim.data.get_body_xmat(name), self.sim.data.get_body_xpos(name))

    def joint_position(self, name: str) -> float:
        """Position of a fixture's joint, metres or radians."""
        return float(self.sim.data.get_joint_qpos(name))

    def close(self) -> None:
        """Free the simulator."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self._env.close()


def _batched(state: Mapping[str, Any]) -> dict[str, Any]:
    return {k: _batched(v) if isinstance(v, Mapping) else np.asarray(v)[None] for k, v in state.items()}
