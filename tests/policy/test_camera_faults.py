"""Cameras that go black, freeze, fall silent or send numbers that are none, in the middle of an episode."""

import logging
from collections.abc import Callable, Iterator

import pytest
import torch
from lerobot.envs.utils import preprocess_observation
from tests.policy.conftest import Frame, batch_of

from lerobot_openspm.control.state import Status
from lerobot_openspm.envs.tabletop.env import TabletopEnv
from lerobot_openspm.modeling_openspm import OpenSPMPolicy

FRONT = "observation.images.front"
SEED = 2_000_003
BROKEN_AT = 8

# What a camera makes of its last sound picture and the present one; None for no picture at all.
Spoil = Callable[[torch.Tensor, torch.Tensor], torch.Tensor | None]
SPOILED: dict[str, Spoil] = {
    "black": lambda last, now: torch.zeros_like(now),
    "frozen": lambda last, now: last,
    "missing": lambda last, now: None,
    "nan": lambda last, now: torch.full_like(now, torch.nan),
    "infinite in one place": lambda last, now: torch.where(now == now.max(), torch.inf, now),
}


def episode(policy: OpenSPMPolicy, spoil: Spoil, broken: range) -> Iterator[torch.Tensor]:
    """Live actions; the front camera is broken for some steps."""
    env = TabletopEnv("turn_on_stove", observation_height=128, observation_width=128)
    observation, _ = env.reset(seed=SEED)
    policy.reset()
    last = None
    for step in range(broken.stop + 20):
        frame = frame_of(env, observation)
        if step in broken:
            image = spoil(last, frame[FRONT])
            frame = {k: v for k, v in frame.items() if k != FRONT} | ({} if image is None else {FRONT: image})
        else:
            last = frame[FRONT]
        with torch.inference_mode():
            action = policy.select_action(batch_of([frame]))[0]
        yield action
        observation, _, terminated, _, _ = env.step(action.numpy())
        if terminated:
            break
    env.close()


def frame_of(env: TabletopEnv, observation: dict) -> Frame:
    frame = preprocess_observation(
        {"pixels": observation["pixels"], "agent_pos": observation["agent_pos"][None]}
    )
    return {key: value[0] for key, value in frame.items()} | {"task": env.task_description}


@pytest.mark.parametrize("name", SPOILED)
def test_a_broken_camera_stops_the_hand_after_half_a_second_and_the_episode_after_two(
    policy: OpenSPMPolicy, name: str, caplog: pytest.LogCaptureFixture
):
    with caplog.at_level(logging.WARNING):
        actions = torch.stack(list(episode(policy, SPOILED[name], range(BROKEN_AT, BROKEN_AT + 50))))
    assert torch.isfinite(actions).all()
    moving = actions[:, :6].abs().max(dim=1).values > 0
    assert moving[: BROKEN_AT + 5].any()
    # Half a second is ten steps; a frozen picture is news until the hand has moved, by 20 mm.
    limit = 15 if name == "frozen" else 10
    assert not moving[BROKEN_AT + limit :].any()
    assert policy.episodes[0].controller.state.status is Status.CAMERA_FAULT
    assert repr(FRONT) in caplog.text


@pytest.mark.parametrize("name", SPOILED)
def test_a_camera_that_is_back_within_half_a_second_stops_nothing(policy: OpenSPMPolicy, name: str):
    actions = torch.stack(list(episode(policy, SPOILED[name], range(BROKEN_AT, BROKEN_AT + 6))))
    assert torch.isfinite(actions).all()
    assert actions[:, :6].abs().max(dim=1).values.all()
    assert policy.episodes[0].controller.state.status is Status.RUNNING


def test_cameras_that_are_dark_from_the_start_end_the_episode_too(
    policy: OpenSPMPolicy, recorded: list[list[Frame]], caplog: pytest.LogCaptureFixture
):
    dark = {k: torch.zeros_like(v) if "image" in k else v for k, v in recorded[0][0].items()}
    for _ in range(60):
        assert not policy.select_action(batch_of([dark]))[..., :6].any()
    assert policy.episodes[0].controller.state.status is Status.CAMERA_FAULT
    assert "is black" in caplog.text
