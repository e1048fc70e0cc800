"""Scenes that the policy must not act in: it says which object or camera is the reason, and nothing moves."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.policy.conftest import batch_of
from tests.policy.test_camera_faults import frame_of

from lerobot_openspm.control.state import EpisodeState, Status
from lerobot_openspm.envs.tabletop.env import TabletopEnv
from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator
from lerobot_openspm.geometry import se3
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.objects.base import Look

SEEDS = (2_600_400, 2_600_401)
STEPS = 6
SIZE = 256
CLOSE, FORWARD = np.array([0.0, 0, 0, 0, 0, 0, 1.0]), np.array([1.0, 0, 0, 0, 0, 0, -1.0])


@pytest.fixture
def env() -> Iterator[TabletopEnv]:
    made = TabletopEnv("bowl_on_plate", observation_height=SIZE, observation_width=SIZE)
    yield made
    made.close()


def put(simulator: TabletopSimulator, position: tuple | np.ndarray) -> None:
    simulator.put("bowl", se3.transform(np.eye(3), position))


def in_no_view(simulator: TabletopSimulator) -> None:
    put(simulator, (3.0, 3.0, 0.0))


def in_the_hand(simulator: TabletopSimulator, forward: int = 10) -> None:
    """The gripper around the bowl's rim, some steps of 2 cm before its home."""
    for _ in range(forward):
        simulator.apply(FORWARD)
    at = simulator.ee_pose()[:3, 3] - [0.0, 0.053, 0.040]
    for _ in range(14):
        put(simulator, at)
        simulator.apply(CLOSE)


def in_the_hand_at_home(simulator: TabletopSimulator) -> None:
    in_the_hand(simulator, forward=0)


def under_another(simulator: TabletopSimulator) -> None:
    put(simulator, (*simulator.object_poses()["cabinet"][:2, 3], 0.08))


def tipped(simulator: TabletopSimulator) -> None:
    place = simulator.object_poses()["bowl"][:2, 3]
    turn = Rotation.from_euler("x", 60, degrees=True).as_matrix()
    simulator.put("bowl", se3.transform(turn, np.array([*place, 0.06])))


def look(policy: OpenSPMPolicy, env: TabletopEnv, steps: int = 1) -> tuple[EpisodeState, np.ndarray]:
    """What becomes of an episode in a scene that nobody changes, and the actions ``(steps, 7)``."""
    policy.reset()
    actions = []
    for _ in range(steps):
        observation = {
            "pixels": {name: env.simulator.render(name, SIZE, SIZE) for name in ("front", "side", "wrist")},
            "agent_pos": env.state(),
        }
        with torch.inference_mode():
            actions.append(policy.select_action(batch_of([frame_of(env, observation)]))[0].numpy())
    return policy.episodes[0].controller.state, np.stack(actions)


def hold_still(policy: OpenSPMPolicy, env: TabletopEnv) -> EpisodeState:
    """What becomes of an episode whose actions are all still, from the scene as it is."""
    state, actions = look(policy, env, STEPS)
    assert not actions[:, :6].any()
    return state


# The bowl in the hand at home hides from the front camera a place behind the table's middle that no other
# camera shows; there it would be taken to stand, were what the fingers are around not left out.
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("spoil", "status", "words"),
    [
        (in_no_view, Status.OBJECT_NOT_FOUND, "cannot find the bowl"),
        (in_the_hand, Status.OBJECT_NOT_FOUND, "the fingers are around something"),
        (in_the_hand_at_home, Status.OBJECT_NOT_FOUND, "the fingers are around something"),
        (under_another, Status.OBJECT_NOT_FOUND, "cannot find the bowl"),
        (tipped, Status.OBJECT_NOT_FOUND, "has tipped over"),
    ],
    ids=lambda one: getattr(one, "__name__", ""),
)
def test_what_cannot_be_grasped_as_it_was_shown_is_refused_by_name(
    policy: OpenSPMPolicy,
    env: TabletopEnv,
    spoil: Callable[[TabletopSimulator], None],
    status: Status,
    words: str,
    seed: int,
):
    env.reset(seed=seed)
    spoil(env.simulator)
    state = hold_still(policy, env)
    assert state.status is status
    assert "bowl" in state.refusal
    assert words in state.refusal


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_half_out_of_all_views_is_refused_for_that_alone(
    load: Callable[..., OpenSPMPolicy], env: TabletopEnv, monkeypatch: pytest.MonkeyPatch, seed: int
):
    # The few demonstrations of the tests went no further than 30 cm to this side; the arm reaches further.
    policy = load(reach_margin_m=0.2)
    env.reset(seed=seed)
    put(env.simulator, (0.1, -0.485, 0.0))
    state = hold_still(policy, env)
    assert state.status is Status.OBJECT_NOT_FOUND
    assert re.fullmatch("no view shows more than [34][0-9] % of the bowl", state.refusal)
    monkeypatch.setattr(Look, "seen_share", lambda *_: 1.0)
    assert look(policy, env)[0].status is Status.RUNNING


@pytest.mark.parametrize("kind", ["2 cm", "3 degrees"])
@pytest.mark.parametrize("camera", ["front", "side", "wrist"])
def test_a_wrong_calibration_is_reported_before_anything_moves(
    policy: OpenSPMPolicy, env: TabletopEnv, camera: str, kind: str
):
    env.reset(seed=SEEDS[0])
    key = spoil_calibration(policy, camera, kind)
    state = hold_still(policy, env)
    assert state.status is Status.CAMERA_FAULT
    faults = policy.episodes[0].controller.scene.detections.faults
    assert "views disagree: it shows objects " in faults[key].reason
    assert "views disagree" in state.refusal


def test_a_wrong_calibration_is_reported_when_a_camera_that_was_dark_at_first_works(
    policy: OpenSPMPolicy, env: TabletopEnv
):
    observation, _ = env.reset(seed=SEEDS[0])
    spoil_calibration(policy, "side", "2 cm")
    dark = {**observation["pixels"], "front": np.zeros((SIZE, SIZE, 3), np.uint8)}
    with torch.inference_mode():
        policy.select_action(batch_of([frame_of(env, {**observation, "pixels": dark})]))
        for _ in range(STEPS):
            policy.select_action(batch_of([frame_of(env, observation)]))
    state = policy.episodes[0].controller.state
    assert state.status is Status.CAMERA_FAULT
    assert "views disagree" in state.refusal


def spoil_calibration(policy: OpenSPMPolicy, camera: str, kind: str) -> str:
    """Set a camera's pose off by 2 cm or by 3 degrees; its key."""
    memory, key = policy.require_memory(), f"observation.images.{camera}"
    turn = Rotation.from_rotvec(np.deg2rad([3.0, 0.0, 0.0])).as_matrix()
    T_cam_off = se3.transform(np.eye(3), [0.02, 0, 0]) if kind == "2 cm" else se3.transform(turn, np.zeros(3))
    off = replace(memory.cameras[key], T_mount_cam=memory.cameras[key].T_mount_cam @ T_cam_off)
    policy.memory = replace(memory, cameras={**memory.cameras, key: off})
    return key


@pytest.mark.parametrize("seed", SEEDS)
def test_views_that_agree_are_acted_on(policy: OpenSPMPolicy, env: TabletopEnv, seed: int):
    observation, _ = env.reset(seed=seed)
    with torch.inference_mode():
        action = policy.select_action(batch_of([frame_of(env, observation)]))
    state = policy.episodes[0].controller.state
    assert (state.status, state.refusal) == (Status.RUNNING, "")
    assert action[..., :6].any()
