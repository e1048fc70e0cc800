from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tests.mining import episodes
from tests.mining.episodes import SPEED, Drawer

from lerobot_openspm.geometry import se3
from lerobot_openspm.mining.key_poses import find_key_poses
from lerobot_openspm.mining.signals import observe_robot

NOISE_M = 0.0002
CONTACTS = ("grasp", "place", "release", "push", "open", "turn")


def mine(drawing, with_convention=True, **options):
    episode = drawing.episode(**options)
    others = [episodes.pick_and_place()[0].episode()] if with_convention else []
    return find_key_poses(episode, observe_robot([episode, *others]))


def at_contacts(key_poses):
    return [pose.phase for pose in key_poses if pose.phase in CONTACTS]


def frame_of(key_poses, phase):
    (frame,) = [pose.frame for pose in key_poses if pose.phase == phase]
    return frame


def near(key_poses, frame, phases):
    return any(abs(pose.frame - frame) <= 3 and pose.phase in phases for pose in key_poses)


@pytest.mark.parametrize("noise", [0.0, NOISE_M])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("options", [{}, {"pause": 25}, {"detour": True}, {"yaw": 0.8}], ids=str)
def test_pick_and_place(options, sign, noise):
    drawing, at = episodes.pick_and_place(close_command=sign, **options)
    key_poses = mine(drawing, with_convention=False, noise=noise)
    assert at_contacts(key_poses) == ["grasp", "place", "release"]
    assert abs(frame_of(key_poses, "grasp") - at["grasp"]) <= 3
    assert at["place"] - 3 <= frame_of(key_poses, "place") <= at["let go"] + 3
    assert abs(frame_of(key_poses, "release") - at["release"]) <= 3
    assert abs(key_poses[-1].frame - at["retreat"]) <= 3
    assert key_poses[-1].phase == "retreat"
    # The arrival, before the fingers move, and the corners that matter.
    grasp = next(i for i, pose in enumerate(key_poses) if pose.phase == "grasp")
    arrival = key_poses[grasp - 1]
    assert arrival.phase == "approach"
    assert at["arrive"] - 3 <= arrival.frame <= at["touch"] + 3
    assert key_poses[grasp + 1].phase == "lift"
    for corner, phases in (
        ("above", ["approach"]),
        ("lift", ["lift", "pre-place"]),
        ("pre-place", ["pre-place"]),
    ):
        height = drawing.episode().T_world_ee[at[corner]]
        assert (
            min(float(se3.distance(pose.T_world_ee, height)) for pose in key_poses if pose.phase in phases)
            < 0.045
        )


def test_frames_go_up_and_poses_are_those_of_their_frames():
    drawing, _ = episodes.pick_and_place(pause=10, detour=True)
    episode, key_poses = drawing.episode(), mine(drawing)
    frames = [pose.frame for pose in key_poses]
    assert frames == sorted(set(frames))
    for pose in key_poses:
        np.testing.assert_array_equal(pose.T_world_ee, episode.T_world_ee[pose.frame])
        assert pose.opening == episode.opening[pose.frame]
        assert 0.5 <= pose.confidence <= 1


def test_fingers_and_contacts_of_pick_and_place():
    key_poses = mine(episodes.pick_and_place()[0])
    closed = {"grasp", "lift", "pre-place", "place"}
    assert all(pose.closed == (pose.phase in closed) for pose in key_poses)
    assert all(pose.dwell == (pose.phase in ("grasp", "release")) for pose in key_poses)
    contacts = {"approach": 0, "grasp": 0, "lift": 1, "pre-place": 1, "place": 1, "release": 1, "retreat": 2}
    assert all(pose.contact == contacts[pose.phase] for pose in key_poses)


def test_pauses_add_no_key_poses_and_no_steps():
    quick, slow = mine(episodes.pick_and_place()[0]), mine(episodes.pick_and_place(pause=40)[0])
    assert [pose.phase for pose in slow] == [pose.phase for pose in quick]
    for a, b in zip(quick, slow, strict=True):
        assert float(se3.distance(a.T_world_ee, b.T_world_ee)) < 0.02
        assert abs(a.n_steps - b.n_steps) <= 4


def test_detours_change_nothing_at_the_contacts():
    straight, detour = mine(episodes.pick_and_place()[0]), mine(episodes.pick_and_place(detour=True)[0])
    grasp = [next(i for i, pose in enumerate(found) if pose.phase == "grasp") for found in (straight, detour)]
    from_arrival = [found[i - 1 :] for found, i in zip((straight, detour), grasp, strict=True)]
    assert [pose.phase for pose in from_arrival[1]] == [pose.phase for pose in from_arrival[0]]
    for a, b in zip(*from_arrival, strict=True):
        assert float(se3.distance(a.T_world_ee, b.T_world_ee)) < 0.01
    corner = detour[0].T_world_ee[:3, 3]
    np.testing.assert_allclose(corner, [-0.2, 0.1, 0.35], atol=0.02)


@pytest.mark.parametrize("noise", [0.0, NOISE_M])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_pushing_with_a_fist(sign, noise):
    drawing, at = episodes.push(close_command=sign)
    lead = episodes.pick_and_place(close_command=sign)[0].episode()
    episode = drawing.episode(task="push the plate to the front of the stove", noise=noise)
    key_poses = find_key_poses(episode, observe_robot([episode, lead]))
    assert at_contacts(key_poses) == ["push"]
    i = next(i for i, pose in enumerate(key_poses) if pose.phase == "push")
    assert key_poses[i - 1].phase == "approach"
    assert abs(key_poses[i - 1].frame - at["approach"]) <= 3
    assert abs(key_poses[i].frame - at["push"]) <= 3
    assert abs(key_poses[-1].frame - at["retreat"]) <= 3
    assert key_poses[-1].phase == "retreat"
    assert all(pose.closed for pose in key_poses[i - 1 :])


@pytest.mark.parametrize("noise", [0.0, NOISE_M])
@pytest.mark.parametrize(("draw", "phase"), [(episodes.pull, "open"), (episodes.turn, "turn")])
def test_pulling_a_drawer_and_turning_a_knob(draw, phase, noise):
    drawing, at = draw()
    key_poses = mine(drawing, noise=noise)
    assert at_contacts(key_poses) == ["grasp", phase, "release"]
    for name in ("grasp", phase, "release", "retreat"):
        assert abs(frame_of(key_poses, name) - at[name]) <= 3, name
    assert near(key_poses, at["approach"], ["approach"])


def test_a_drawer_and_then_a_bowl_count_their_contacts_up():
    drawing, _ = episodes.pull()
    drawing.move([0.1, -0.2, 0.14])
    drawing.move([0.1, -0.2, 0.02])
    drawing.grip(True)
    drawing.move([0.1, -0.2, 0.16])
    drawing.move([0.05, 0.2, 0.16])
    drawing.move([0.05, 0.2, 0.05])
    drawing.grip(False)
    drawing.move([0.05, 0.2, 0.2])
    key_poses = mine(drawing)
    contacts = [(pose.phase, pose.contact) for pose in key_poses if pose.phase in CONTACTS]
    assert contacts == [("grasp", 0), ("open", 1), ("release", 1), ("grasp", 2), ("place", 3), ("release", 3)]


def test_an_episode_without_touch_has_no_key_poses():
    waving = Drawer([0.0, 0.0, 0.3])
    waving.move([0.1, 0.2, 0.4])
    assert mine(waving) == []
    # A dip is no push.
    waving.move([0.1, 0.2, 0.1])
    waving.move([-0.1, 0.1, 0.3])
    assert mine(waving) == []


def false_start(held):
    """Takes the bowl at the second try: the fingers close, open again over it, and close."""
    d = Drawer([0.0, 0.0, 0.3])
    d.move([0.1, -0.2, 0.14])
    at = {"arrive": d.move([0.1, -0.2, 0.02])}
    d.grip(True, n=6, held=held)
    at["close"] = d.grip(False)
    at["grasp"] = d.grip(True)
    d.move([0.1, -0.2, 0.16])
    d.move([0.05, 0.2, 0.16])
    d.move([0.05, 0.2, 0.05])
    d.grip(False)
    d.move([0.05, 0.2, 0.2])
    return d, at


@pytest.mark.parametrize("held", [0.0, episodes.HELD], ids=["nothing", "something"])
def test_a_closing_after_which_the_hand_stays_until_it_opens_again_is_no_grasp(held):
    drawing, at = false_start(held)
    key_poses = mine(drawing, noise=NOISE_M)
    assert at_contacts(key_poses) == ["grasp", "place", "release"]
    assert abs(frame_of(key_poses, "grasp") - at["grasp"]) <= 1
    arrival = next(pose for pose, after in pairwise(key_poses) if after.phase == "grasp")
    assert (arrival.phase, abs(arrival.frame - at["close"]) <= 1) == ("approach", True)


def test_a_thing_that_is_carried_a_little_and_put_down_again_was_grasped():
    d = Drawer([0.0, 0.0, 0.3])
    d.move([0.1, -0.2, 0.02])
    d.grip(True)
    d.move([0.1, -0.15, 0.02])
    d.grip(False)
    d.move([0.1, -0.15, 0.2])
    assert at_contacts(mine(d)) == ["grasp", "open", "release"]


def test_a_grasp_and_a_release_end_when_the_hand_leaves_and_not_when_it_trembles():
    d = Drawer([0.0, 0.0, 0.3])
    d.move([0.1, -0.2, 0.14])
    d.move([0.1, -0.2, 0.02])
    at = {}
    for name, closed in (("grasp", True), ("release", False)):
        d.grip(closed)
        for aside in (0.003, -0.003, 0.003, 0.0):
            d.move(d.position + np.array([aside, aside, 0.0]), speed=0.0015)
            d.wait(3)
        at[name] = d.frame
        d.move(d.position + np.array([0.0, 0.0, 0.14]))
        if closed:
            d.move([0.05, 0.2, 0.16])
            d.move([0.05, 0.2, 0.05])
    key_poses = mine(d, noise=NOISE_M)
    assert at_contacts(key_poses) == ["grasp", "place", "release"]
    for name, frame in at.items():
        assert abs(frame_of(key_poses, name) - frame) <= 1, name


def test_a_thing_is_put_down_when_the_fingers_part_and_not_when_they_are_told_to():
    drawing, at = episodes.pick_and_place()
    episode, told, late = drawing.episode(), at["let go"], 5
    opening = episode.opening.copy()
    opening[told + late :] = episode.opening[told:-late]
    eased = np.linspace(0, 0.0005, late)  # a grip that grows less tight opens fingers a little
    opening[told : told + late] = episode.opening[told] + eased
    key_poses = find_key_poses(replace(episode, opening=opening), observe_robot([episode]))
    assert abs(frame_of(key_poses, "place") - (told + late)) <= 1
    assert abs(frame_of(key_poses, "release") - at["release"]) <= 1


def pushing(*way, speed=SPEED, leave=True):
    """Sinks, pushes along the way `(y, z)`, and rises; with the frame at which the push ends."""
    d = Drawer([0.0, 0.0, 0.3])
    d.move([0.1, -0.1, 0.15])
    d.move([0.1, -0.1, 0.02])
    for y, z in way:
        d.move([0.1, y, z], speed=speed)
    end = d.frame
    if leave:
        d.move([0.1, d.position[1], 0.2])
    return d, end


@pytest.mark.parametrize("noise", [0.0, NOISE_M])
@pytest.mark.parametrize("speed", [0.003, SPEED])
@pytest.mark.parametrize(
    "way",
    [
        pytest.param([(0.0, 0.02), (0.03, 0.042), (0.06, 0.042), (0.09, 0.02), (0.12, 0.02)], id="rides up"),
        pytest.param([(0.04, 0.02), (0.07, 0.036)], id="up at the end"),
        pytest.param([(0.05, 0.02), (0.08, 0.042), (0.12, 0.042)], id="ends high"),
    ],
)
def test_a_push_goes_on_while_the_hand_goes_further_than_it_rises(way, speed, noise):
    drawing, end = pushing(*way, speed=speed)
    key_poses = mine(drawing, noise=noise)
    assert at_contacts(key_poses) == ["push"]
    assert abs(frame_of(key_poses, "push") - end) <= 1


@pytest.mark.parametrize("noise", [0.0, NOISE_M])
@pytest.mark.parametrize(("aside", "turns"), [(0.10, 1), (-0.10, 1), (0.02, 0), (0.0, 0)])
def test_a_push_is_cut_where_it_turns(aside, turns, noise):
    d, _ = pushing((0.06, 0.02), leave=False)
    corner = d.frame
    d.move([0.1 + aside, 0.14, 0.02])
    end = d.frame
    d.move([0.1 + aside, 0.14, 0.2])
    pushes = [pose for pose in mine(d, noise=noise) if pose.phase == "push"]
    assert len(pushes) == turns + 1
    assert abs(pushes[-1].frame - end) <= 1
    assert all(abs(pose.frame - corner) <= 2 for pose in pushes[:-1])
    assert all(pose.confidence < 1 for pose in pushes[:-1])


def test_a_hand_that_waits_trembling_has_not_ended_its_push():
    drawing, _ = pushing((0.0, 0.02), (0.05, 0.0345), leave=False)
    for k in range(20):
        drawing.move([0.1, 0.05 + 0.001 * (k % 2), 0.0353 + 0.0008 * (k % 2)], speed=0.002)
    end = drawing.frame
    drawing.move([0.1, 0.05, 0.2])
    assert abs(frame_of(mine(drawing), "push") - end) <= 1


def test_a_hand_that_backs_off_at_a_slant_pushes_no_further():
    drawing, end = pushing((0.05, 0.02), leave=False)
    drawing.move([0.1, -0.1, 0.12])
    assert abs(frame_of(mine(drawing), "push") - end) <= 1


def test_a_hand_that_dips_and_lifts_off_before_it_pushes_has_pushed_once():
    d = Drawer([0.0, 0.0, 0.3])
    d.move([0.1, -0.3, 0.025])
    d.move([0.1, -0.25, 0.06])
    d.move([0.1, -0.1, 0.06])
    start = d.move([0.1, -0.1, 0.02])
    end = d.move([0.1, 0.05, 0.02])
    d.move([0.1, 0.05, 0.2])
    key_poses = mine(d)
    assert at_contacts(key_poses) == ["push"]
    assert abs(frame_of(key_poses, "push") - end) <= 1
    assert max(pose.frame for pose in key_poses if pose.phase == "approach") == pytest.approx(start, abs=1)


def test_a_flicker_of_the_gripper_command_is_no_contact():
    clean = episodes.pick_and_place()[0].episode()
    actions = clean.actions.copy()
    actions[[10, 11, 12, 75, 76], 6] *= -1
    flickering = replace(clean, actions=actions)
    robot = observe_robot([clean])
    expected = [(pose.frame, pose.phase) for pose in find_key_poses(clean, robot)]
    assert [(pose.frame, pose.phase) for pose in find_key_poses(flickering, robot)] == expected


def test_an_episode_that_ends_while_carrying_keeps_its_grasp():
    episode = episodes.pick_and_place()[0].episode()
    n = 90
    cut = replace(
        episode, T_world_ee=episode.T_world_ee[:n], opening=episode.opening[:n], actions=episode.actions[:n]
    )
    phases = [pose.phase for pose in find_key_poses(cut, observe_robot([episode]))]
    assert "grasp" in phases
    assert "release" not in phases
