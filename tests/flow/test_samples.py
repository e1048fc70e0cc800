import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.mining import episodes
from tests.mining.episodes import Drawer

from lerobot_openspm.flow.condition import CONDITION_DIM, progress, to_world_frame
from lerobot_openspm.flow.samples import action_scale, conditions_and_chunks, perturbed, segment_frames
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.mining.key_poses import KeyPose, find_key_poses
from lerobot_openspm.mining.signals import observe_robot

H = 5
FROM = 1000


def key_pose(episode, frame, phase="approach", closed=False):
    dwell = phase in ("grasp", "release")
    return KeyPose(
        frame, episode.T_world_ee[frame], phase, 1.0, closed, float(episode.opening[frame]), 1, dwell, 0
    )


@pytest.fixture(scope="module")
def demonstration():
    """Twenty steps along x, fifteen along y, a grasp of ten."""
    drawing = Drawer([0.0, 0.0, 0.3])
    first, second = drawing.move([0.2, 0.0, 0.3]), drawing.move([0.2, 0.15, 0.3], yaw=0.3)
    third = drawing.grip(True)
    episode = drawing.episode(index=7, from_index=FROM)
    poses = [key_pose(episode, first), key_pose(episode, second), key_pose(episode, third, "grasp", True)]
    return episode, poses, observe_robot([episodes.pick_and_place(yaw=0.4)[0].episode(), episode])


@pytest.fixture(scope="module")
def frames(demonstration):
    episode, poses, robot = demonstration
    return segment_frames([episode], [poses], robot, H)


def rows_of(frames, first, last):
    return np.flatnonzero((frames.index >= FROM + first) & (frames.index < FROM + last))


def test_every_frame_of_every_motion_is_taken_once(demonstration, frames):
    _, poses, _ = demonstration
    assert poses[-1].dwell
    assert frames.index.tolist() == list(range(FROM, FROM + poses[1].frame))
    assert set(frames.episode.tolist()) == {7}
    assert frames.actions.shape == (len(frames), H, 7)


def test_each_frame_aims_at_the_end_of_its_own_segment(demonstration, frames):
    episode, poses, robot = demonstration
    begin = 0
    for pose in poses[:-1]:
        rows = rows_of(frames, begin, pose.frame)
        assert len(rows) == pose.frame - begin
        assert_allclose(
            frames.query.T_world_target[rows], np.broadcast_to(pose.T_world_ee, (len(rows), 4, 4))
        )
        assert_allclose(
            frames.T_world_start[rows], np.broadcast_to(episode.T_world_ee[begin], (len(rows), 4, 4))
        )
        assert_allclose(frames.query.T_world_ee[rows], episode.T_world_ee[begin : pose.frame])
        assert_allclose(frames.query.opening[rows], episode.opening[begin : pose.frame] / robot.open_width)
        assert set(frames.query.closed[rows]) == {float(pose.closed)}
        assert set(frames.query.phase[rows]) == {PHASES.index(pose.phase)}
        begin = pose.frame


def test_chunks_are_the_actions_that_followed_and_hold_still_after_the_segment(demonstration, frames):
    episode, poses, robot = demonstration
    end = poses[0].frame
    (inside,) = rows_of(frames, 3, 4)
    assert_allclose(frames.actions[inside, :, :6], episode.actions[3 : 3 + H, :6])
    (late,) = rows_of(frames, end - 2, end - 1)
    assert_allclose(frames.actions[late, :2, :6], episode.actions[end - 2 : end, :6])
    assert_allclose(frames.actions[late, 2:, :6], 0)  # the actions of the next segment are not taken
    assert np.abs(episode.actions[end : end + 3, :6]).max() > 0.5
    begin = 0
    for pose in poses[:-1]:
        commands = frames.actions[rows_of(frames, begin, pose.frame), :, 6]
        assert set(commands.ravel()) == {robot.command(pose.closed)}
        begin = pose.frame


def test_the_demonstration_itself_is_left_as_it_was(demonstration):
    episode, poses, robot = demonstration
    before = episode.actions.copy()
    found = segment_frames([episode], [poses], robot, H)
    perturbed(found, robot, 0.01, 0.1, np.random.default_rng(0))
    assert_allclose(episode.actions, before, rtol=0)


def test_pauses_and_waits_for_the_fingers_are_dropped():
    drawing = Drawer([0.0, 0.0, 0.3])
    stop = drawing.move([0.1, 0.0, 0.3])
    go_on = drawing.wait(20)
    end = drawing.move([0.2, 0.0, 0.3])
    closed = drawing.grip(True)
    episode = drawing.episode()
    poses = [key_pose(episode, end), key_pose(episode, closed, "grasp", True)]
    robot = observe_robot([episodes.pick_and_place()[0].episode()])
    kept = segment_frames([episode], [poses], robot, H).index.tolist()
    assert kept == [*range(stop), *range(go_on, end)]


def test_index_and_episode_of_several_demonstrations():
    drawn = [episodes.pick_and_place()[0], episodes.pull()[0]]
    made = [drawn[0].episode(index=2, from_index=50), drawn[1].episode(index=5, from_index=400)]
    robot = observe_robot(made)
    mined = [find_key_poses(episode, robot) for episode in made]
    frames = segment_frames(made, mined, robot, H)
    assert len(set(frames.index.tolist())) == len(frames)
    for episode in made:
        rows = frames.episode == episode.index
        local = frames.index[rows] - episode.from_index
        assert local.min() == 0
        assert local.max() < len(episode)
        assert_allclose(frames.query.T_world_ee[rows], episode.T_world_ee[local])


def end_of_chunks(frames, robot):
    """Where a hand ends that carries out the chunks, position and rotation vector summed up."""
    gains = np.array([robot.metres_per_action] * 3 + [robot.radians_per_action] * 3)
    T = frames.query.T_world_ee
    for step in np.moveaxis(frames.actions, 1, 0):
        T = se3.apply_increment(T, step[:, :6] * gains)
    return T


def test_perturbed_chunks_end_where_they_did(demonstration, frames):
    _, _, robot = demonstration
    moved = perturbed(frames, robot, 0.01, 0.02, np.random.default_rng(0))
    expected, reached = end_of_chunks(frames, robot), end_of_chunks(moved, robot)
    shift = se3.distances(frames.query.T_world_ee, moved.query.T_world_ee)
    assert shift[0].mean() > 0.005
    metres, radians = se3.distances(reached, expected)
    assert metres.max() < 1e-9
    assert radians.max() < 4e-3  # turns about different axes commute only nearly
    assert_allclose(moved.index, frames.index)
    assert_allclose(moved.query.T_world_target, frames.query.T_world_target)
    assert_allclose(
        moved.query.progress,
        progress(frames.T_world_start, moved.query.T_world_ee, moved.query.T_world_target),
    )


def test_frames_near_the_target_move_less(demonstration, frames):
    _, poses, robot = demonstration
    sizes = []
    for seed in range(30):
        again = perturbed(frames, robot, 0.01, 0.0, np.random.default_rng(seed))
        sizes.append(se3.distances(frames.query.T_world_ee, again.query.T_world_ee)[0])
    mean = np.mean(sizes, axis=0)
    assert mean[poses[0].frame - 1] < 0.6 * mean[0]


def test_what_the_robot_was_never_commanded_to_do_is_not_corrected(demonstration, frames):
    _, _, robot = demonstration
    still = type(robot)(**{**vars(robot), "radians_per_action": 0.0})
    moved = perturbed(frames, still, 0.01, 0.02, np.random.default_rng(0))
    assert np.isfinite(moved.actions).all()
    assert_allclose(moved.actions[..., 3:6], frames.actions[..., 3:6])


@pytest.mark.parametrize("conditioning", CONDITION_DIM)
def test_network_inputs_and_targets(frames, conditioning):
    conditions, chunks = conditions_and_chunks(frames, conditioning)
    assert conditions.shape == (len(frames), CONDITION_DIM[conditioning])
    back = to_world_frame(chunks, frames.query.T_world_target[:, None], conditioning)
    assert_allclose(back, frames.actions, atol=1e-9)


def test_actions_are_scaled_by_their_spread_group_by_group():
    chunks = np.zeros((4, 2, 7))
    chunks[..., 0], chunks[..., 6] = 3.0, -1.0
    assert_allclose(action_scale(chunks), [*[3 / np.sqrt(3)] * 3, *[1e-3] * 3, 1.0])
