"""What is left out of an image is out of sight, also in mirrors. Images are compared in test_simulator.py."""

import mujoco
import numpy as np
import pytest

from lerobot_openspm.envs.libero.rendering import visible_geoms

# The camera stands at the origin, 1 m up, looks along x and 35 degrees down: the horizon is out of sight. In
# the plate it sees what lies 5 degrees over the horizon.
SCENE = """
<mujoco>
  <asset><material name="mirror" reflectance="{reflectance}"/></asset>
  <worldbody>
    <camera name="eye" pos="0 0 1" xyaxes="0 -1 0 .5736 0 .8192" fovy="60"/>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <geom name="plate" type="box" size=".1 .1 .01" pos="1.5 0 .5" material="mirror"/>
    <geom name="ahead" size=".05" pos="2 0 .3"/>
    <geom name="behind" size=".05" pos="-2 0 1"/>
    <geom name="aside" size=".05" pos="1 3 .3"/>
    <geom name="at_the_border" size=".1" pos="1 .75 .3"/>
    <geom name="beyond_the_plate" size=".05" pos="4 0 1.33"/>
    <geom name="far_over_the_plate" size=".05" pos="1.5 0 8"/>
  </worldbody>
</mujoco>
"""


def seen(reflectance: float) -> tuple[dict[str, bool], bool]:
    """By name, whether a geom is kept, and whether a mirror is in sight."""
    model = mujoco.MjModel.from_xml_string(SCENE.format(reflectance=reflectance))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    kept, mirrored = visible_geoms(model, data, model.camera("eye").id)
    return {model.geom(i).name: bool(kept[i]) for i in range(model.ngeom)}, mirrored


def test_only_what_reaches_into_the_picture_is_kept():
    kept, mirrored = seen(0.0)
    assert not mirrored
    assert [name for name, is_kept in kept.items() if is_kept] == ["floor", "plate", "ahead", "at_the_border"]


def test_what_a_mirror_shows_is_kept_as_well():
    kept, mirrored = seen(0.5)
    assert mirrored
    assert kept["beyond_the_plate"]
    assert not kept["behind"]
    assert not kept["far_over_the_plate"]


@pytest.mark.parametrize("angle", np.linspace(-0.5, 0.5, 11))
def test_a_geom_is_kept_wherever_the_camera_sees_its_middle(angle):
    model = mujoco.MjModel.from_xml_string(SCENE.format(reflectance=0.0))
    data = mujoco.MjData(model)
    model.geom("ahead").pos[:] = [1.0, np.tan(angle), 0.3]
    mujoco.mj_forward(model, data)
    kept, _ = visible_geoms(model, data, model.camera("eye").id)
    assert kept[model.geom("ahead").id]
