"""The tabletop's geometry as MJCF: a hand, four movable objects, a rack, a cabinet, a stove; all primitives.

World frame: z up, table top at z = 0. Every object frame has its origin at the centre of the footprint, on
the support surface; the cabinet's and the stove's x axes point out of their fronts.
The `ee` frame sits between the fingertips; its z axis points out of the hand (down at home), the fingers
open along its y axis.
"""

import math

# Bowl: a ring of upright boxes. Thin enough a rim for the fingers to close around.
BOWL_RADIUS = 0.055
BOWL_WALL = 0.0045
BOWL_HEIGHT = 0.050
BOWL_FLOOR = 0.006
PLATE_RADIUS = 0.085
PLATE_RIM_WIDTH = 0.005
PLATE_RIM_HEIGHT = 0.014
PLATE_FLOOR = 0.006
BOX_HALF = (0.030, 0.020, 0.015)
BOTTLE_RADIUS = 0.022
BOTTLE_BODY_HEIGHT = 0.110
BOTTLE_NECK_RADIUS = 0.012
BOTTLE_HEIGHT = 0.160
RACK_HALF = (0.070, 0.045)
RACK_SHELF_HEIGHT = 0.050
RACK_RAIL_HEIGHT = 0.012
CABINET_HALF = (0.100, 0.120)
CABINET_HEIGHT = 0.210
DRAWER_PITCH = 0.066
DRAWER_TRAVEL = 0.160
DRAWER_HALF_WIDTH = 0.104
DRAWER_FRONT_X = 0.110
HANDLE_X = 0.145
STOVE_HALF = (0.110, 0.100)
STOVE_HEIGHT = 0.025
BURNER_X = -0.030
BURNER_RADIUS = 0.070
BURNER_TOP = 0.030
KNOB_X = 0.080
KNOB_RANGE = 2.0
PLATE_GOAL_X = 0.220
FINGER_TRAVEL = 0.040
FINGERTIP_BEYOND_EE = 0.008
HOME_POSITION = (-0.12, 0.0, 0.40)
TIMESTEP_S = 0.0025

OBJECT_NAMES = ("bowl", "plate", "box", "bottle", "rack", "cabinet", "stove")
# Numbers in the simulator's own segmentation; 0 is everything else.
OBJECT_LABELS = {name: number for number, name in enumerate(OBJECT_NAMES, 1)}
MOVABLE_NAMES = ("bowl", "plate", "box", "bottle")
# Another bowl just like the first, only in scenes whose instruction tells which one is meant.
SECOND_BOWL = "second_bowl"
DRAWER_NAMES = ("drawer_bottom", "drawer_middle", "drawer_top")
CAMERA_NAMES = ("front", "side", "wrist")

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


def drawer_height(index: int) -> float:
    """Height of the underside of drawer `index` (0 bottom, 2 top) above the table, in metres."""
    return 0.008 + DRAWER_PITCH * index


def handle_height(index: int) -> float:
    """Height of the centre of the handle of drawer `index`, in metres."""
    return drawer_height(index) + 0.031


def _geom(kind: str, size: tuple, position: tuple, colour: str, extra: str = "") -> str:
    rgb = " ".join(f"{c:g}" for c in COLOURS[colour])
    sizes = " ".join(f"{s:.6g}" for s in size)
    place = " ".join(f"{p:.6g}" for p in position)
    return f'<geom type="{kind}" size="{sizes}" pos="{place}" rgba="{rgb} 1" {extra}/>'


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


def _movables(second_bowl: bool) -> str:
    bowl = (
        _feet(0.035, 0.003, 6, "bowl")
        + _geom(
            "cylinder",
            (BOWL_RADIUS - 0.002, (BOWL_FLOOR - 0.001) / 2),
            (0, 0, (BOWL_FLOOR + 0.001) / 2),
            "bowl",
        )
        + _ring(BOWL_RADIUS, BOWL_WALL, 0.002, BOWL_HEIGHT, 20, "bowl")
    )
    plate = (
        _feet(0.060, 0.0025, 8, "plate")
        + _geom(
            "cylinder",
            (PLATE_RADIUS - 0.002, (PLATE_FLOOR - 0.001) / 2),
            (0, 0, (PLATE_FLOOR + 0.001) / 2),
            "plate",
        )
        + _ring(PLATE_RADIUS, PLATE_RIM_WIDTH, 0.001, PLATE_RIM_HEIGHT, 24, "plate")
    )
    box = _geom("box", BOX_HALF, (0, 0, BOX_HALF[2]), "box")
    neck_half = (BOTTLE_HEIGHT - BOTTLE_BODY_HEIGHT) / 2
    bottle = (
        _feet(0.018, 0.003, 6, "bottle")
        + _geom(
            "cylinder",
            (BOTTLE_RADIUS, (BOTTLE_BODY_HEIGHT - 0.002) / 2),
            (0, 0, (BOTTLE_BODY_HEIGHT + 0.002) / 2),
            "bottle",
        )
        + _geom("cylinder", (BOTTLE_NECK_RADIUS, neck_half), (0, 0, BOTTLE_BODY_HEIGHT + neck_half), "bottle")
    )
    bowl_inertial = _inertial(0.15, 0.018, (2e-4, 2e-4, 3e-4))
    return (
        _movable("bowl", bowl, bowl_inertial)
        + (_movable(SECOND_BOWL, bowl, bowl_inertial) if second_bowl else "")
        + _movable("plate", plate, _inertial(0.20, 0.006, (4e-4, 4e-4, 8e-4)))
        + _movable("box", box, _inertial(0.08, BOX_HALF[2], (1.7e-5, 3e-5, 3.5e-5)))
        + _movable("bottle", bottle, _inertial(0.20, 0.035, (2.5e-4, 2.5e-4, 6e-5)))
    )


def _rack() -> str:
    hx, hy = RACK_HALF
    shelf = _geom("box", (hx, hy, 0.004), (0, 0, RACK_SHELF_HEIGHT - 0.004), "rack")
    legs = "".join(
        _geom("box", (0.004, hy, 0.021), (sign * (hx - 0.004), 0, 0.021), "rack") for sign in (-1, 1)
    )
    rails = "".join(
        _geom(
            "box",
            (hx, 0.004, RACK_RAIL_HEIGHT / 2),
            (0, s * (hy - 0.004), RACK_SHELF_HEIGHT + RACK_RAIL_HEIGHT / 2),
            "rack",
        )
        for s in (-1, 1)
    )
    return f'<body name="rack">{shelf}{legs}{rails}</body>'


def _drawer(index: int) -> str:
    name = DRAWER_NAMES[index]
    width, front = DRAWER_HALF_WIDTH, DRAWER_FRONT_X
    bar_x, mid = HANDLE_X, 0.031
    geoms = (
        _geom("box", (0.095, width, 0.003), (0.005, 0, 0.005), "drawer")
        + _geom("box", (0.095, 0.003, 0.022), (0.005, width + 0.003, 0.026), "drawer")
        + _geom("box", (0.095, 0.003, 0.022), (0.005, -width - 0.003, 0.026), "drawer")
        + _geom("box", (0.003, width, 0.022), (-0.090, 0, 0.026), "drawer")
        + _geom("box", (0.005, CABINET_HALF[1] - 0.002, 0.031), (front - 0.005, 0, mid), "drawer")
        + _geom("box", (0.006, 0.006, 0.022), (bar_x, 0, mid), "handle")
        + "".join(
            _geom(
                "box",
                ((bar_x - front) / 2, 0.003, 0.003),
                ((bar_x + front) / 2, 0, mid + s * 0.019),
                "handle",
            )
            for s in (-1, 1)
        )
    )
    return (
        f'<body name="{name}" pos="0 0 {drawer_height(index):.4f}">'
        f'<joint name="{name}" type="slide" axis="1 0 0" range="0 {DRAWER_TRAVEL}" limited="true" '
        f'damping="8" frictionloss="2" armature="0.1"/>'
        f"{_inertial(0.5, 0.02, (2e-3, 2e-3, 4e-3))}{geoms}</body>"
    )


def _cabinet() -> str:
    hx, hy = CABINET_HALF
    walls = (
        _geom("box", (hx, hy, 0.003), (0, 0, 0.003), "cabinet")
        + _geom("box", (hx, hy, 0.002), (0, 0, CABINET_HEIGHT - 0.002), "cabinet")
        + _geom("box", (hx, 0.003, 0.101), (0, hy - 0.003, 0.107), "cabinet")
        + _geom("box", (hx, 0.003, 0.101), (0, -hy + 0.003, 0.107), "cabinet")
        + _geom("box", (0.003, hy - 0.006, 0.101), (-hx + 0.003, 0, 0.107), "cabinet")
    )
    return f'<body name="cabinet">{walls}{"".join(_drawer(i) for i in range(3))}</body>'


def _stove() -> str:
    hx, hy = STOVE_HALF
    half_disc = (BURNER_TOP - STOVE_HEIGHT) / 2
    body = _geom("box", (hx, hy, STOVE_HEIGHT / 2), (0, 0, STOVE_HEIGHT / 2), "stove") + _geom(
        "cylinder", (BURNER_RADIUS, half_disc), (BURNER_X, 0, STOVE_HEIGHT + half_disc), "burner"
    )
    knob = _geom("cylinder", (0.018, 0.006), (0, 0, 0.006), "knob") + _geom(
        "box", (0.024, 0.005, 0.012), (0, 0, 0.024), "knob"
    )
    return (
        f'<body name="stove">{body}<body name="knob" pos="{KNOB_X} 0 {STOVE_HEIGHT}">'
        f'<joint name="knob" type="hinge" axis="0 0 1" range="0 {KNOB_RANGE}" limited="true" damping="0.01" '
        f'frictionloss="0.03" armature="0.001"/>'
        f"{_inertial(0.05, 0.015, (1e-5, 1e-5, 1e-5))}{knob}</body></body>"
    )


def _finger(name: str, sign: int) -> str:
    low, high = sorted((-0.001 * sign, (FINGER_TRAVEL + 0.001) * sign))
    return (
        f'<body name="{name}" gravcomp="1">'
        f'<joint name="{name}" type="slide" axis="0 1 0" range="{low} {high}" limited="true" '
        f'damping="70" armature="0.05" solreflimit="0.006 1" solimplimit="0.95 0.99 0.0005"/>'
        + _inertial(0.05, -0.02, (1e-5, 1e-5, 1e-5))
        + _geom(
            "box",
            (0.010, 0.004, 0.030),
            (0, sign * 0.004, FINGERTIP_BEYOND_EE - 0.030),
            "finger",
            'class="finger"',
        )
        + "</body>"
    )


def _hand() -> str:
    palm_z = FINGERTIP_BEYOND_EE - 0.060 - 0.015
    return (
        '<body name="hand" gravcomp="1"><freejoint name="hand"/>'
        + _inertial(1.0, -0.05, (2e-3, 2e-3, 2e-3))
        + _geom("box", (0.020, 0.050, 0.015), (0, 0, palm_z), "hand")
        + _geom("cylinder", (0.024, 0.030), (0, 0, palm_z - 0.045), "hand")
        + '<camera name="wrist" pos="-0.07 0 -0.06" xyaxes="0 -1 0 -0.866 0 0.5" fovy="75"/>'
        + _finger("finger_left", 1)
        + _finger("finger_right", -1)
        + '</body><body name="hand_target" mocap="true"/>'
    )


def _excludes() -> str:
    pairs = [("finger_left", "finger_right")]
    pairs += [("cabinet", d) for d in DRAWER_NAMES]
    pairs += [(a, b) for i, a in enumerate(DRAWER_NAMES) for b in DRAWER_NAMES[i + 1 :]]
    return "".join(f'<exclude body1="{a}" body2="{b}"/>' for a, b in pairs)


def build_mjcf(second_bowl: bool = False) -> str:
    """Return the scene as an MJCF string; object poses are set at reset, not here."""
    table = _geom("box", (0.46, 0.49, 0.02), (0.03, 0, -0.0201), "table", 'contype="0" conaffinity="0"')
    floor = _geom("box", (4, 4, 0.01), (0, 0, -0.71), "floor", 'contype="0" conaffinity="0"')
    # Walls, so that the level hand's camera sees no black horizon; a skybox is slower by half.
    sides = [((0.01, 4, 3), (x, 0, 2.29)) for x in (-4, 4)] + [((4, 0.01, 3), (0, y, 2.29)) for y in (-4, 4)]
    floor += "".join(_geom("box", half, at, "floor", 'contype="0" conaffinity="0"') for half, at in sides)
    return f"""<mujoco model="openspm_tabletop">
  <compiler angle="radian"/>
  <option timestep="{TIMESTEP_S}" integrator="implicitfast" cone="elliptic" impratio="10"
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
    {table}{floor}{_hand()}{_movables(second_bowl)}{_rack()}{_cabinet()}{_stove()}
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
