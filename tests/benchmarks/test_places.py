"""What is made of estimates and true places, without a simulator."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.libero import places
from benchmarks.libero.place_errors import is_right, judged, not_known, of_object, summary
from benchmarks.libero.places import LEARNED, PlacesConfig, learning, look_at_scene

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.kinds import KINDS
from lerobot_openspm.perception.objects.patches.learn import learn_patches
from lerobot_openspm.types import PoseEstimate

T_SIM_OBJ = se3.from_yaw([0.01, 0.0, -0.02], 0.3)


class Known:
    yaw_period = 2 * np.pi
    # Of one side alone, as cameras see it: their middle is not on the axis.
    points = se3.apply(se3.inverse(T_SIM_OBJ), np.array([[0.03, 0.0, 0.0], [0.03, 0.01, 0.05]]))


MODELS = {"black bowl": Known(), "milk": Known()}


def estimate(T, status="found", confidence=0.99, others=()):
    return PoseEstimate(status, T, 1e-6 * np.eye(4), confidence, others=tuple(others))


def at(x: float, yaw: float = 0.0) -> np.ndarray:
    return se3.from_yaw([x, 0.0, 0.9], yaw)


def row(name, found, poses, meant=None):
    return judged(name, found, meant or found, poses, T_SIM_OBJ, MODELS)


def test_errors_are_those_of_the_learned_frame():
    off = se3.from_yaw([0.003, 0.0, 0.9], 0.1)
    told = row("milk", estimate(off @ T_SIM_OBJ), {"milk": at(0.0)})
    expected = np.linalg.norm((off @ T_SIM_OBJ - at(0.0) @ T_SIM_OBJ)[:3, 3])
    assert told["mm"] == pytest.approx(1000 * expected, abs=0.06)
    assert told["deg"] == pytest.approx(np.rad2deg(0.1), abs=0.06)
    assert (told["found"], told["of"], told["near"]) == (True, 1, 1)
    assert is_right(told)


def test_of_two_of_a_kind_that_which_is_meant_counts_and_no_yaw_of_a_round_one():
    poses = {"bowl": at(0.0), "bowl_2": at(0.3)}
    first, second = at(0.004, 1.0) @ T_SIM_OBJ, at(0.3) @ T_SIM_OBJ
    both = estimate(second, "ambiguous", others=[first])
    told = row("black bowl", both, poses, estimate(first))
    assert (told["found"], told["of"], told["deg"], told["near"]) == (True, 2, None, 2)
    assert is_right(told)
    other = row("black bowl", both, poses, estimate(second))
    assert other["mm"] > 290
    assert row("black bowl", estimate(second), poses, estimate(second))["near"] == 1


def test_of_two_of_a_kind_that_no_words_tell_apart_none_is_found():
    both = estimate(at(0.3), "ambiguous", others=[at(0.0)])
    told = row("black bowl", both, {"bowl": at(0.0), "bowl_2": at(0.3)})
    assert told == {"found": False, "confidence": 0.99, "of": 2}


def test_however_a_round_thing_is_found_turned_its_axis_counts():
    there, turned = at(0.0) @ T_SIM_OBJ, se3.from_yaw([0.004, 0.0, 0.9], 2.0) @ T_SIM_OBJ
    assert 1000 * np.linalg.norm((turned - there)[:3, 3]) > 10
    assert row("black bowl", estimate(turned), {"bowl": at(0.0)})["mm"] == pytest.approx(4.0, abs=0.06)
    assert row("milk", estimate(turned), {"milk": at(0.0)})["mm"] > 10


def test_an_ambiguous_single_thing_is_not_found():
    told = row("milk", estimate(at(0.0), "ambiguous"), {"milk": at(0.0)})
    assert told == {"found": False, "confidence": 0.99, "of": 1}


def test_what_is_not_there_but_reported_is_wrong():
    told = row("milk", estimate(at(0.0)), {"bowl": at(0.0)})
    assert told["of"] == 0
    assert not is_right(told)
    assert of_object([told])["absent"] == {"n": 1, "reported": 1}


def test_shares_are_of_the_scenes_that_hold_a_thing_and_sure_ones_of_all():
    def told(mm, deg=1.0, confidence=0.99, found=True, of=1):
        kept = {"found": found, "confidence": confidence, "of": of}
        return {**kept, "mm": mm, "deg": deg, "near": int(mm < 10)} if found else kept

    rows = [
        told(2.0),
        told(4.0, deg=15.0),
        told(12.0, confidence=0.5),
        told(0, found=False),
        told(0, found=False, of=0),
    ]
    object_row = of_object(rows)
    assert object_row["found"]["success"] == 0.75
    assert object_row["found"]["n"] == 4
    assert object_row["within_10_mm"]["success"] == 0.5
    assert (object_row["position_mm_median"], object_row["yaw_deg_median"]) == (4.0, 1.0)
    whole = summary(
        [{"task": "t", "seed": i, "look_cpu_ms": 10, "objects": {"milk": r}} for i, r in enumerate(rows)]
    )
    assert whole["all"] == object_row
    assert (whole["sure"]["success"], whole["sure"]["n"]) == (0.5, 2)
    assert whole["sure_and_wrong"] == [["milk", "t", 1, 4.0, 15.0]]
    assert whole["first_look_cpu_ms"] == {"median": 10.0, "p95": 10.0}


def test_what_was_not_learned_is_not_found_in_the_scenes_that_hold_it():
    told = not_known("black bowl", {"bowl": at(0.0), "bowl_2": at(0.3), "milk": at(0.1)}, {})
    assert told == {"found": False, "confidence": 0.0, "of": 2}
    absent = not_known("black bowl", {"milk": at(0.1)}, {})
    row = of_object([told, absent])
    assert (row["found"]["success"], row["found"]["n"]) == (0.0, 1)
    assert row["within_10_mm"]["success"] == 0.0
    assert row["absent"] == {"n": 1, "reported": 0}


def test_every_thing_that_the_hand_touched_is_in_a_scenes_row(tmp_path: Path, monkeypatch):
    touched = {"milk": {"T_sim_obj": T_SIM_OBJ.tolist()}, "black bowl": {"T_sim_obj": None}}
    (tmp_path / LEARNED).write_text(json.dumps({"objects": touched}))
    poses = {"milk": at(0.0), "bowl": at(0.3)}
    simulator = SimpleNamespace(object_poses=lambda: poses)
    monkeypatch.setattr(places, "read_memory", lambda _: SimpleNamespace(objects={"milk": Known()}))
    monkeypatch.setattr(places, "draw", lambda *_: (simulator, 7))
    found = {"milk": estimate(poses["milk"] @ T_SIM_OBJ)}
    monkeypatch.setattr(places, "observe", lambda *_: None)
    monkeypatch.setattr(places, "look", lambda *_: (found, 0.1))
    monkeypatch.setattr(places, "sorted_out", lambda *_: found)
    row = look_at_scene(PlacesConfig("libero_object"), tmp_path, "a task", 3)
    assert (row["seed"], row["look_cpu_ms"]) == (7, 100)
    assert row["objects"]["milk"]["mm"] == 0.0
    assert row["objects"]["black bowl"] == {"found": False, "confidence": 0.0, "of": 1}


def test_no_two_scenes_have_the_same_seed():
    # The tasks of libero_goal draw the same scene from a seed.
    drawn = PlacesConfig(scenes=10).drawn(["one", "another"])
    assert [task for task, _ in drawn] == ["one"] * 10 + ["another"] * 10
    assert len({seed for _, seed in drawn}) == 20


def test_another_suite_is_refused_by_name():
    with pytest.raises(ValueError, match="expected one of libero_goal, libero_spatial, libero_object"):
        PlacesConfig("libero_90")


def test_kinds_are_named_by_the_figure_and_unknown_ones_refused():
    assert PlacesConfig(exchanged=True).name == "places_libero_goal_exchanged"
    assert PlacesConfig(exchanged=True, demos=3).name == "places_libero_goal_exchanged_demos_3"
    some = PlacesConfig(exchanged=True, kinds="patches,shape")
    assert some.name == "places_libero_goal_exchanged_patches_shape"
    with pytest.raises(ValueError, match=r"no kinds \['sphere'\], expected all or some of surface, patches"):
        PlacesConfig(kinds="patches,sphere")


def test_patches_learn_by_themselves_where_surfaces_do_not():
    assert learning(["patches", "shape"])["patches"].learn is learn_patches
    assert learning(list(KINDS)) == KINDS
