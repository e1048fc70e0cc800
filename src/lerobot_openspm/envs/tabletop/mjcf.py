"""The tabletop as MJCF: everything is made of MuJoCo's primitives."""

import math
from collections.abc import Sequence

from lerobot_openspm.envs.tabletop import scene

# Far from one another in CIELAB, so that an object can be told by its colour under any shading of its faces.
COLOURS = {
    "bowl": (0.10, 0.22, 0.85),
    "plate": (0.92, 0.92, 0.92),
    "box": (0.98, 0.86, 0.08),
    "bottle": (0.03, 0.42, 0.12),
    "rack": (0.72, 0.12, 0.70),
    "cabinet": (0.62, 0.10, 0.08),
    "drawer": (0.86, 0.22, 0.16),
    "handle": (0.98, 0.72, 0.62),
    "stove": (0.07, 0.07, 0.08),
    "burner": (0.10, 0.66, 0.72),
    "knob": (1.00, 0.50, 0.00),
    "hand": (0.46, 0.47, 0.50),
    "finger": (0.28, 0.29, 0.33),
    "table": (0.76, 0.65, 0.50),
    "floor": (0.30, 0.35, 0.38),
}


def _geom(kind: str, size: tuple, position: tuple, colour: str, extra: str = "") -> str:
    rgb = " ".join(f"{c:g}" for c in COLOURS[colour])
    sizes = " ".join(f"{s:.6g}" for s in size)
    place = " ".join(f"{p:.6g}" for p in position)
    return f'<geom type="{kind}" size="{sizes}" pos="{place}" rgba="{rgb} 1" {extra}/>'


def _boxes(colour: str, *halves_and_places: tuple[tuple, tuple]) -> str:
    """Boxes of one colour, each given by its half sides and its middle."""
    return "".join(_geom("box", half, place, colour) for half, place in halves_and_places)


def _cylinder(radius: float, low: float, high: float, colour: str, x: float = 0) -> str:
    """An upright cylinder from one height to another."""
    return _geom("cylinder", (radius, (high - low) / 2), (x, 0, (high + low) / 2), colour)


def _ring(radius: float, thickness: float, z_low: float, z_high: float, count: int, colour: str) -> str:
    """Upright boxes around the z axis; `radius` is the outer one."""
    middle = radius - thickness / 2
    half_length = radius * math.tan(math.pi / count)
    size = (thickness / 2, half_length, (z_high - z_low) / 2)
    geoms = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        position = (middle * math.cos(angle), middle * math.sin(angle), (z_low + z_high) / 2)
        geoms.append(_geom("box", size, position, colour, f'euler="0 0 {angle:.6g}"'))
    return "".join(geoms)


def _feet(radius: float, size: float, count: int, colour: str) -> str:
    """Small spheres to stand on: they meet boxes, planes and cylinders in closed form, without jitter."""
    angles = [2 * math.pi * i / count for i in range(count)]
    return "".join(
        _geom("sphere", (size,), (radius * math.cos(a), radius * math.sin(a), size), colour, 'group="4"')
        for a in angles
    )


def _movable(name: str, geoms: str, inertial: str) -> str:
    return f'<body name="{name}"><freejoint name="{name}"/>{inertial}{geoms}</body>'


def _inertial(mass: float, height: float, inertia: tuple) -> str:
    diagonal = " ".join(f"{i:g}" for i in inertia)
    return f'<inertial pos="0 0 {height:g}" mass="{mass:g}" diaginertia="{diagonal}"/>'


def _shapes() -> dict[str, tuple[str, str]]:
    """Geoms and inertia of everything that can be moved, by name."""
    bowl = (
        _feet(0.035, 0.003, 6, "bowl")
        + _cylinder(scene.BOWL_RADIUS - 0.002, 0.001, scene.BOWL_FLOOR, "bowl")
        + _ring(scene.BOWL_RADIUS, scene.BOWL_WALL, 0.002, scene.BOWL_HEIGHT, 20, "bowl")
    )
    plate = (
        _feet(0.060, 0.0025, 8, "plate")
        + _cylinder(scene.PLATE_RADIUS - 0.002, 0.001, scene.PLATE_FLOOR, "plate")
        + _ring(scene.PLATE_RADIUS, scene.PLATE_RIM_WIDTH, 0.001, scene.PLATE_RIM_HEIGHT, 24, "plate")
    )
    box = _boxes("box", (scene.BOX_HALF, (0, 0, scene.BOX_HALF[2])))
    bottle = (
        _feet(0.018, 0.003, 6, "bottle")
        + _cylinder(scene.BOTTLE_RADIUS, 0.002, scene.BOTTLE_BODY_HEIGHT, "bottle")
        + _cylinder(scene.BOTTLE_NECK_RADIUS, scene.BOTTLE_BODY_HEIGHT, scene.BOTTLE_HEIGHT, "bottle")
    )
    return {
        "bowl": (bowl, _inertial(0.15, 0.018, (2e-4, 2e-4, 3e-4))),
        "plate": (plate, _inertial(0.20, 0.006, (4e-4, 4e-4, 8e-4))),
        "box": (box, _inertial(0.08, scene.BOX_HALF[2], (1.7e-5, 3e-5, 3.5e-5))),
        "bottle": (bottle, _inertial(0.20, 0.035, (2.5e-4, 2.5e-4, 6e-5))),
        "mug": (_mug(), _inertial(0.25, 0.03, (3e-4, 3e-4, 3e-4))),
        "arch": (_arch(), _inertial(0.20, scene.ARCH_HALF[2], (2e-4, 2e-4, 2e-4))),
    }


def _mug() -> str:
    """A cup with a handle, blue as the bowl."""
    radius, top, handle = scene.MUG_RADIUS, scene.MUG_HEIGHT, scene.MUG_HANDLE
    bars = _boxes(
        "bowl",
        ((0.003, 0.004, 0.022), (radius + handle - 0.003, 0, 0.045)),
        *(((handle / 2, 0.004, 0.004), (radius + handle / 2, 0, 0.045 + z)) for z in (-0.018, 0.018)),
    )
    floor = _feet(radius - 0.008, 0.003, 6, "bowl") + _cylinder(radius - 0.002, 0.001, 0.006, "bowl")
    return floor + _ring(radius, 0.004, 0.002, top, 16, "bowl") + bars


def _arch() -> str:
    """A block with a gate in it, yellow as the box."""
    (hx, hy, hz), (gate, top) = scene.ARCH_HALF, scene.ARCH_OPENING
    leg = (hx - gate) / 2
    return _boxes(
        "box",
        ((hx, hy, hz - top / 2), (0, 0, hz + top / 2)),
        *(((leg, hy, top / 2), (sign * (hx - leg), 0, top / 2)) for sign in (-1, 1)),
    )


def _movables(others: Sequence[str]) -> str:
    shapes = _shapes()
    return "".join(_movable(name, *shapes[scene.kind(name)]) for name in (*scene.MOVABLE_NAMES, *others))


def _rack() -> str:
    (hx, hy), shelf_z, rail = scene.RACK_HALF, scene.RACK_SHELF_HEIGHT, scene.RACK_RAIL_HEIGHT
    boxes = _boxes(
        "rack",
        ((hx, hy, 0.004), (0, 0, shelf_z - 0.004)),
        *(((0.004, hy, 0.021), (sign * (hx - 0.004), 0, 0.021)) for sign in (-1, 1)),
        *(((hx, 0.004, rail / 2), (0, sign * (hy - 0.004), shelf_z + rail / 2)) for sign in (-1, 1)),
    )
    return f'<body name="rack">{boxes}</body>'


def _drawer(index: int) -> str:
    name = scene.DRAWER_NAMES[index]
    width, front, bar_x, mid = scene.DRAWER_HALF_WIDTH, scene.DRAWER_FRONT_X, scene.HANDLE_X, 0.031
    drawer = _boxes(
        "drawer",
        ((0.095, width, 0.003), (0.005, 0, 0.005)),
        ((0.095, 0.003, 0.022), (0.005, width + 0.003, 0.026)),
        ((0.095, 0.003, 0.022), (0.005, -width - 0.003, 0.026)),
        ((0.003, width, 0.022), (-0.090, 0, 0.026)),
        ((0.005, scene.CABINET_HALF[1] - 0.002, 0.031), (front - 0.005, 0, mid)),
    )
    bar, middle_x = ((bar_x - front) / 2, 0.003, 0.003), (bar_x + front) / 2
    handle = _boxes(
        "handle",
        ((0.006, 0.006, 0.022), (bar_x, 0, mid)),
        *((bar, (middle_x, 0, mid + sign * 0.019)) for sign in (-1, 1)),
    )
    return (
        f'<body name="{name}" pos="0 0 {scene.drawer_height(index):.4f}">'
        f'<joint name="{name}" type="slide" axis="1 0 0" range="0 {scene.DRAWER_TRAVEL}" limited="true" '
        f'damping="8" frictionloss="2" armature="0.1"/>'
        f"{_inertial(0.5, 0.02, (2e-3, 2e-3, 4e-3))}{drawer}{handle}</body>"
    )


def _cabinet() -> str:
    hx, hy = scene.CABINET_HALF
    walls = _boxes(
        "cabinet",
        ((hx, hy, 0.003), (0, 0, 0.003)),
        ((hx, hy, 0.002), (0, 0, scene.CABINET_HEIGHT - 0.002)),
        ((hx, 0.003, 0.101), (0, hy - 0.003, 0.107)),
        ((hx, 0.003, 0.101), (0, -hy + 0.003, 0.107)),
        ((0.003, hy - 0.006, 0.101), (-hx + 0.003, 0, 0.107)),
    )
    return f'<body name="cabinet">{walls}{"".join(_drawer(i) for i in range(3))}</body>'


def _stove() -> str:
    top = scene.STOVE_HEIGHT
    body = _boxes("stove", ((*scene.STOVE_HALF, top / 2), (0, 0, top / 2)))
    burner = _cylinder(scene.BURNER_RADIUS, top, scene.BURNER_TOP, "burner", scene.BURNER_X)
    knob = _cylinder(0.018, 0, 0.012, "knob") + _boxes("knob", ((0.024, 0.005, 0.012), (0, 0, 0.024)))
    return (
        f'<body name="stove">{body}{burner}<body name="knob" pos="{scene.KNOB_X} 0 {top}">'
        f'<joint name="knob" type="hinge" axis="0 0 1" range="0 {scene.KNOB_RANGE}" limited="true" '
        f'damping="0.01" frictionloss="0.03" armature="0.001"/>'
        f"{_inertial(0.05, 0.015, (1e-5, 1e-5, 1e-5))}{knob}</body></body>"
    )


def _finger(name: str, sign: int) -> str:
    low, high = sorted((-0.001 * sign, (scene.FINGER_TRAVEL + 0.001) * sign))
    place = (0, sign * 0.004, scene.FINGERTIP_BEYOND_EE - 0.030)
    return (
        f'<body name="{name}" gravcomp="1">'
        f'<joint name="{name}" type="slide" axis="0 1 0" range="{low} {high}" limited="true" '
        f'damping="70" armature="0.05" solreflimit="0.006 1" solimplimit="0.95 0.99 0.0005"/>'
        f"{_inertial(0.05, -0.02, (1e-5, 1e-5, 1e-5))}"
        f"{_geom('box', (0.010, 0.004, 0.030), place, 'finger', 'class="finger"')}</body>"
    )


def _hand() -> str:
    palm_z = scene.FINGERTIP_BEYOND_EE - 0.060 - 0.015
    return (
        '<body name="hand" gravcomp="1"><freejoint name="hand"/>'
        + _inertial(1.0, -0.05, (2e-3, 2e-3, 2e-3))
        + _boxes("hand", ((0.020, 0.050, 0.015), (0, 0, palm_z)))
        + _geom("cylinder", (0.024, 0.030), (0, 0, palm_z - 0.045), "hand")
        + '<camera name="wrist" pos="-0.07 0 -0.06" xyaxes="0 -1 0 -0.866 0 0.5" fovy="75"/>'
        + _finger("finger_left", 1)
        + _finger("finger_right", -1)
        + '</body><body name="hand_target" mocap="true"/>'
    )


def _excludes() -> str:
    pairs = [("finger_left", "finger_right")]
    pairs += [("cabinet", d) for d in scene.DRAWER_NAMES]
    pairs += [(a, b) for i, a in enumerate(scene.DRAWER_NAMES) for b in scene.DRAWER_NAMES[i + 1 :]]
    return "".join(f'<exclude body1="{a}" body2="{b}"/>' for a, b in pairs)


def build_mjcf(others: Sequence[str] = ()) -> str:
    """Return the scene as an MJCF string; object poses are set at reset, not here.

    Args:
        others: Names of what stands there beside the tasks' objects: distractors, and second objects.
    """
    table = _geom("box", (0.46, 0.49, 0.02), (0.03, 0, -0.0201), "table", 'contype="0" conaffinity="0"')
    floor = _geom("box", (4, 4, 0.01), (0, 0, -0.71), "floor", 'contype="0" conaffinity="0"')
    # Walls, so that the level hand's camera sees no black horizon; a skybox is slower by half.
    sides = [((0.01, 4, 3), (x, 0, 2.29)) for x in (-4, 4)] + [((4, 0.01, 3), (0, y, 2.29)) for y in (-4, 4)]
    floor += "".join(_geom("box", half, at, "floor", 'contype="0" conaffinity="0"') for half, at in sides)
    return f"""<mujoco model="openspm_tabletop">
  <compiler angle="radian"/>
  <option timestep="{scene.TIMESTEP_S}" integrator="implicitfast" cone="elliptic" impratio="10"
    noslip_iterations="3"/>
  <size memory="64M"/>
  <statistic extent="1" center="0 0 0"/>
  <visual>
    <headlight ambient="0.55 0.55 0.55" diffuse="0.10 0.10 0.10" specular="0 0 0"/>
    <global offwidth="640" offheight="640"/>
    <map znear="0.01" zfar="10"/>
    <quality offsamples="4" numslices="20" numstacks="6" numquads="1"/>
  </visual>
  <default>
    <geom friction="0.6 0.005 0.0001" condim="4"/>
    <default class="finger">
      <geom friction="1.5 0.05 0.0002" condim="4" priority="1" solref="0.008 1" solimp="0.95 0.99 0.0005"/>
    </default>
  </default>
  <worldbody>
    <light directional="true" pos="0 0 2" dir="-0.25 0.2 -1"
      diffuse="0.45 0.45 0.45" specular="0 0 0" castshadow="false"/>
    <camera name="front" pos="0.945 0 1.280" xyaxes="0 1 0 -0.788 0 0.616" fovy="35"/>
    <camera name="side" pos="0.060 -0.905 1.230" xyaxes="1 0 0 0 0.788 0.616" fovy="35"/>
    <geom name="table" type="plane" size="1 1 0.1" rgba="0 0 0 0" group="4"/>
    {table}{floor}{_hand()}{_movables(others)}{_rack()}{_cabinet()}{_stove()}
  </worldbody>
  <contact>{_excludes()}</contact>
  <equality>
    <weld body1="hand_target" body2="hand" solref="0.025 1" solimp="0.9 0.95 0.001"/>
    <joint joint1="finger_left" joint2="finger_right" polycoef="0 -1 0 0 0" solref="0.005 1"/>
  </equality>
  <actuator>
    <position name="finger_left" joint="finger_left" kp="600" forcerange="-10 10"/>
    <position name="finger_right" joint="finger_right" kp="600" forcerange="-10 10"/>
  </actuator>
</mujoco>"""
