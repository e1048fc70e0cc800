import logging
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.envs.utils import preprocess_observation
from tests.policy.conftest import Frame, act, batch_of

from lerobot_openspm.errors import ObservationError
from lerobot_openspm.geometry import se3
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.observation import split_batch


def test_what_is_loaded_acts_as_what_was_saved(
    policy: OpenSPMPolicy, load: Callable[..., OpenSPMPolicy], recorded: list[list[Frame]], tmp_path: Path
):
    actions = act(policy, recorded)
    assert actions.shape == (len(recorded[0]), 6, 7)
    assert torch.isfinite(actions).all()
    assert actions[:, 0, :6].abs().max() > 0.01, "the hand never moves"
    policy.save_pretrained(tmp_path / "once")
    again = load(tmp_path / "once")
    again.save_pretrained(tmp_path / "twice")
    assert torch.equal(act(again, recorded), actions)
    names = sorted(path.name for path in (tmp_path / "once").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "twice").iterdir())
    for name in names:
        assert (tmp_path / "once" / name).read_bytes() == (tmp_path / "twice" / name).read_bytes(), name


def test_a_row_acts_the_same_in_any_batch(policy: OpenSPMPolicy, recorded: list[list[Frame]]):
    rows = [*recorded, recorded[3], recorded[0]]
    together = act(policy, rows)
    reversed_rows = act(policy, rows[::-1])
    assert torch.equal(reversed_rows.flip(1), together)
    for i, row in enumerate(rows):
        assert torch.equal(act(policy, [row])[:, 0], together[:, i]), f"row {i}"


def test_reset_forgets(policy: OpenSPMPolicy, recorded: list[list[Frame]]):
    first = act(policy, recorded[:2])
    act(policy, recorded[3:5])
    assert torch.equal(act(policy, recorded[:2]), first)


def test_a_row_whose_instruction_changes_starts_anew_and_the_others_go_on(
    policy: OpenSPMPolicy, recorded: list[list[Frame]]
):
    alone, other = act(policy, recorded[:1]), act(policy, recorded[3:4])
    policy.reset()
    half = len(alone) // 2
    for t in range(half):
        policy.select_action(batch_of([recorded[0][t], recorded[1][t]]))
    for t in range(half):
        actions = policy.select_action(batch_of([recorded[0][half + t], recorded[3][t]]))
        assert torch.equal(actions[0], alone[half + t, 0])
        assert torch.equal(actions[1], other[t, 0])


def test_the_seed_of_the_noise_matters_and_nothing_else_does(
    load: Callable[..., OpenSPMPolicy], recorded: list[list[Frame]]
):
    torch.manual_seed(1)
    first = act(load(execution="closed_loop"), recorded[:1])
    torch.manual_seed(2)
    assert torch.equal(act(load(execution="closed_loop"), recorded[:1]), first)
    assert not torch.equal(act(load(execution="closed_loop", noise_seed=1), recorded[:1]), first)


@pytest.mark.parametrize("execution", ["open_loop", "closed_loop", "closed_loop_trc"])
@pytest.mark.parametrize("n_action_steps", [1, 5])
def test_every_execution_acts(
    load: Callable[..., OpenSPMPolicy], recorded: list[list[Frame]], execution: str, n_action_steps: int
):
    policy = load(execution=execution, n_action_steps=n_action_steps)
    assert torch.isfinite(act(policy, recorded[:1])).all()
    policy.reset()
    chunk = policy.predict_action_chunk(batch_of([recorded[0][0], recorded[3][0]]))
    assert chunk.shape == (2, policy.config.chunk_size, 7)
    assert torch.isfinite(chunk).all()


def test_a_chunk_goes_on_from_where_its_actions_take_the_hand(
    policy: OpenSPMPolicy, recorded: list[list[Frame]]
):
    (observation,) = split_batch(batch_of([recorded[0][0]]), policy.config.layouts()[0])
    actions = policy.act([observation], 5)[0]
    robot, (episode,) = policy.require_memory().robot, policy.episodes
    here, end = observation.hand.T_world_ee, episode.controller.executor.present.T_world_ee
    for action in actions:
        there = robot.moved(here, action)
        assert float(se3.distance(here, there)) <= 1.01 * robot.metres_per_step
        assert float(se3.distance(there, end)) < float(se3.distance(here, end))
        here = there


def test_a_chunk_is_predicted_without_changing_anything(policy: OpenSPMPolicy, recorded: list[list[Frame]]):
    unasked = act(policy, recorded[:2])
    policy.reset()
    policy.train()
    for t, expected in enumerate(unasked):
        batch = batch_of([recorded[0][t], recorded[1][t]])
        policy.train(t % 2 == 0)
        first, second = policy.predict_action_chunk(batch), policy.predict_action_chunk(batch)
        assert policy.training == (t % 2 == 0)
        assert torch.equal(first, second)
        assert torch.equal(first[:, 0], expected), "its first action is the one that comes next"
        assert torch.equal(policy.select_action(batch), expected)
    # Neither is another instruction taken up, nor are other environments.
    other = batch_of([recorded[3][0], recorded[1][len(unasked) - 1], recorded[4][0]])
    rows = list(policy.episodes)
    assert policy.predict_action_chunk(other).shape == (3, policy.config.chunk_size, 7)
    assert policy.episodes == rows


def test_a_chunk_that_cannot_be_predicted_changes_nothing(policy: OpenSPMPolicy, recorded: list[list[Frame]]):
    unasked = act(policy, recorded[:1])
    policy.reset()
    first = recorded[0][0]
    blind = {key: value for key, value in first.items() if "image" not in key}
    with pytest.raises(ObservationError):
        policy.predict_action_chunk(batch_of([blind]))
    assert torch.equal(policy.select_action(batch_of([first])), unasked[0])


def test_an_object_that_is_out_of_sight_stops_the_hand(
    policy: OpenSPMPolicy, recorded: list[list[Frame]], caplog: pytest.LogCaptureFixture
):
    dark = [
        {k: torch.zeros_like(v) if "image" in k else v for k, v in frame.items()} for frame in recorded[0]
    ]
    with caplog.at_level(logging.INFO):
        actions = act(policy, [dark])
    assert not actions[..., :6].any()
    assert "cannot find" in caplog.text


def test_live_environments_act_the_same_together_and_alone(policy: OpenSPMPolicy):
    from lerobot_openspm.envs.tabletop.env import TabletopEnv

    seeds, steps = (2_000_003, 2_000_004, 2_000_005), 12
    envs = [TabletopEnv("turn_on_stove", observation_height=128, observation_width=128) for _ in seeds]

    def observe(env: TabletopEnv, observation: dict) -> Frame:
        frame = preprocess_observation(
            {"pixels": observation["pixels"], "agent_pos": observation["agent_pos"][None]}
        )
        return {key: value[0] for key, value in frame.items()} | {"task": env.task_description}

    def rollout(rows: list[int]) -> torch.Tensor:
        policy.reset()
        frames = [observe(envs[i], envs[i].reset(seed=seeds[i])[0]) for i in rows]
        actions = []
        for _ in range(steps):
            with torch.inference_mode():
                actions.append(policy.select_action(batch_of(frames)))
            frames = [
                observe(envs[i], envs[i].step(action.numpy())[0])
                for i, action in zip(rows, actions[-1], strict=True)
            ]
        return torch.stack(actions, dim=1)

    try:
        together = rollout([0, 1, 2])
        assert torch.equal(torch.cat([rollout([i]) for i in (0, 1, 2)]), together)
        assert together[..., :6].abs().max() > 0.01
    finally:
        for env in envs:
            env.close()
