"""Contacts with objects that are not of a task: who touched what, and how far it was moved."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from benchmarks.libero.contacts import Contacts, shares, task_objects

from lerobot_openspm.envs.libero.simulator import OBJECTS, LiberoSimulator
from lerobot_openspm.envs.seeds import TUNING_SEED_START

# A robot's finger that is led along x pushes the bowl, the bowl the cheese that lies behind it and the bottle
# that stands a little farther off, side by side with the cheese. All others are far away.
ROW = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="robot0_finger"><joint name="x" type="slide" axis="1 0 0" damping="50"/>
      <geom type="sphere" size="0.02" mass="1"/></body>
    {objects}
  </worldbody>
  <actuator><position joint="x" kp="500"/></actuator>
</mujoco>
"""
THINGS = tuple(OBJECTS["libero_goal"])
PLACES = {"bowl": (0.06, 0), "cheese": (0.12, 0), "bottle": (0.14, 0.0595)}


def scene() -> Any:
    """A stand-in for LIBERO's simulator: cubes with edges of 6 cm that slide without gravity."""
    body = (
        '<body name="{0}_main" pos="{1} {2} 0"><joint type="slide" axis="1 0 0" damping="5"/>'
        '<body name="{0}_part"><geom type="box" size="0.03 0.03 0.03" mass="0.1"/></body></body>'
    )
    far = {name: (1.0, i) for i, name in enumerate(THINGS)}
    objects = "".join(body.format(name, *{**far, **PLACES}[name]) for name in THINGS)
    model = mujoco.MjModel.from_xml_string(ROW.format(objects=objects))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    sim = SimpleNamespace(model=SimpleNamespace(_model=model), data=SimpleNamespace(_data=data))
    return SimpleNamespace(
        sim=sim, root_body=lambda name: f"{name}_main", object_poses=lambda: dict.fromkeys(THINGS)
    )


def lead(simulator: Any, watch: Contacts, x: float) -> dict[str, float]:
    model, data = simulator.sim.model._model, simulator.sim.data._data
    data.ctrl[0] = x
    for _ in range(1000):
        mujoco.mj_step(model, data)
        watch.note()
    return watch.told()


def test_what_stands_side_by_side_is_not_touched():
    simulator = scene()
    watch = Contacts(simulator, set())
    watch.note()
    assert simulator.sim.data._data.ncon > 0
    assert watch.told() == {}


def test_a_touch_is_told_with_how_far_it_moved_the_object():
    simulator = scene()
    told = lead(simulator, Contacts(simulator, set()), 0.015)
    assert list(told) == ["bowl"]
    assert 1 < told["bowl"] < 10


def test_what_is_pushed_touches_in_the_robots_stead():
    simulator = scene()
    told = lead(simulator, Contacts(simulator, {"bowl"}), 0.05)
    assert list(told) == ["cheese", "bottle"]
    assert told["cheese"] > 15


def test_objects_of_the_task_may_be_touched():
    simulator = scene()
    assert lead(simulator, Contacts(simulator, {"bowl", "cheese", "bottle"}), 0.05) == {}


@pytest.mark.parametrize(
    ("instruction", "goal", "expected"),
    [
        ("Put the bowl on the plate", "(On akita_black_bowl_1 plate_1)", {"bowl", "plate"}),
        ("open the middle layer", "(Open yellow_cabinet_1_middle_region)", {"cabinet"}),
        ("push the plate to the stove's front", "(On plate_1 main_table_front_region)", {"plate", "stove"}),
        ("move it over there", "(On plate_1 main_table_front_region)", {"plate"}),
        ("put the cheese, gently", "(On red_cream_cheese_1 main_table_rack_region)", {"cheese"}),
    ],
)
def test_objects_of_a_task_are_those_of_its_words_and_its_goal(tmp_path: Path, instruction, goal, expected):
    file = tmp_path / "task.bddl"
    file.write_text(f"(:init (On wine_bottle_1 main_table_bottle_region))\n(:goal (And {goal}))")
    assert task_objects(instruction, file) == expected


@pytest.mark.parametrize(
    ("suite", "instruction", "goal", "expected"),
    [
        (
            "libero_spatial",
            "pick up the black bowl next to the cookie box and place it on the plate",
            "(On akita_black_bowl_1 plate_1)",
            {"bowl", "cookie_box", "plate"},
        ),
        (
            "libero_object",
            "pick up the tomato sauce and place it in the basket",
            "(In tomato_sauce_1 basket_1_contain_region)",
            {"tomato_sauce", "basket"},
        ),
        (
            "libero_10",
            "put the yellow and white mug in the microwave and close it",
            "(In white_yellow_mug_1 microwave_1_heating_region)",
            {"yellow_and_white_mug", "microwave"},
        ),
        (
            "libero_10",
            "put both moka pots on the stove",
            "(On moka_pot_1 flat_stove_1_cook_region) (On moka_pot_2 flat_stove_1_cook_region)",
            {"moka_pot", "moka_pot_2", "stove"},
        ),
    ],
)
def test_objects_of_other_suites_are_told_apart(tmp_path: Path, suite, instruction, goal, expected):
    file = tmp_path / "task.bddl"
    file.write_text(f"(:goal (And {goal}))")
    assert task_objects(instruction, file, suite) == expected


def test_shares_are_of_episodes():
    found = [{}, {"plate": 0.2}, {"plate": 0.2, "bowl": 10.1}, {}]
    assert shares(found) == {"touched": 0.5, "moved": 0.25}
    assert shares([]) == {"touched": None, "moved": None}


@pytest.mark.libero
def test_a_hand_led_down_onto_the_plate_touches_the_plate_and_one_on_the_table_nothing():
    simulator, seed = LiberoSimulator("turn_on_the_stove"), TUNING_SEED_START + 92
    simulator.reset(seed)
    plate = simulator.object_poses()["plate"][:3, 3]
    free = plate + np.array([0.0, 0.20, 0.0])
    for goal, of_task, expected in (
        (free, {"stove"}, []),
        (plate, {"stove", "plate"}, []),
        (plate, {"stove"}, ["plate"]),
    ):
        simulator.reset(seed)
        watch = Contacts(simulator, of_task)
        for height in (0.15, -0.05):
            for _ in range(40):
                off = goal + np.array([0.0, 0.0, height]) - simulator.ee_pose()[:3, 3]
                simulator.step(np.array([*np.clip(10 * off, -1, 1), 0.0, 0.0, 0.0, 1.0]))
                watch.note()
        assert list(watch.told()) == expected
    simulator.close()
