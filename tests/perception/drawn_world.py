"""A small world drawn with convex polygons: boxes and cylinders on a plane, two cameras, no simulator."""

from dataclasses import replace

import cv2
import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera, project
from lerobot_openspm.types import ContactCue, DemonstrationScene, View

SIZE = 160
TABLE = (196, 166, 128)
# Half sizes (a cylinder has its radius twice), height, colours of sides and top, whether it is round.
SHAPES = {
    "block": ((0.06, 0.03), 0.05, (150, 30, 20), (225, 60, 40), False),
    "cup": ((0.04, 0.04), 0.06, (15, 35, 130), (40, 80, 220), True),
}
DISTRACTOR = ((0.035, 0.035), 0.05, (10, 110, 40), (20, 180, 60), True)


def cameras() -> dict[str, tuple[Camera, np.ndarray]]:
    """Two cameras 0.9 m away that look at the middle of the table from the front and from the side."""
    placed = {}
    for name, azimuth in (("front", 0.0), ("side", 1.7)):
        position = 0.9 * np.array([0.65 * np.cos(azimuth), 0.65 * np.sin(azimuth), 0.76])
        forward = -position / np.linalg.norm(position)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        T_world_cam = se3.transform(np.stack([right, np.cross(forward, right), forward], axis=1), position)
        middle = (SIZE - 1) / 2
        placed[name] = (Camera(SIZE, SIZE, 200.0, 200.0, middle, middle, "world", T_world_cam), T_world_cam)
    return placed


def hand_camera(T_world_ee: np.ndarray) -> dict[str, tuple[Camera, np.ndarray]]:
    """The front camera, and one that the hand carries; the hand's frame is the camera's."""
    middle = (SIZE - 1) / 2
    hand = Camera(SIZE, SIZE, 110.0, 110.0, middle, middle, "ee", np.eye(4))
    return {"front": cameras()["front"], "hand": (hand, T_world_ee)}


def render(
    objects: list[tuple[tuple, np.ndarray]],
    T_moved: np.ndarray | None = None,
    placed: dict[str, tuple[Camera, np.ndarray]] | None = None,
) -> dict[str, View]:
    """Draw shapes at ``T_world_obj``, the furthest first, antialiased; ``T_moved`` moves the cameras."""
    views = {}
    for name, (camera, T_world_usual) in (placed or cameras()).items():
        T_world_cam = T_world_usual if T_moved is None else T_moved @ T_world_usual
        image = np.full((4 * SIZE, 4 * SIZE, 3), TABLE, np.uint8)
        order = sorted(objects, key=lambda pair: -np.linalg.norm(pair[1][:3, 3] - T_world_cam[:3, 3]))
        for (half, height, side, top, is_round), T in order:
            angle = np.arange(48) * 2 * np.pi / 48 if is_round else np.deg2rad([45, 135, 225, 315])
            reach = np.ones(2) if is_round else np.sqrt([2, 2])
            rim = np.stack([half[0] * reach[0] * np.cos(angle), half[1] * reach[1] * np.sin(angle)], axis=1)
            low, high = (np.column_stack([rim, np.full(len(rim), z)]) for z in (0.0, height))
            for points, colour in ((np.vstack([low, high]), side), (high, top)):
                uv, _ = project(camera, T_world_cam, se3.apply(T, points))
                corners = cv2.convexHull(np.rint((uv + 0.5) * 4 * 16 - 8).astype(np.int32))
                cv2.fillConvexPoly(image, corners, colour, shift=4)
        image = cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        views[name] = View(image, camera, T_world_cam)
    return views


def draw_pose(rng: np.random.Generator, low: tuple, high: tuple) -> np.ndarray:
    x, y, yaw = rng.uniform((*low, -np.pi), (*high, np.pi))
    return se3.from_yaw([x, y, 0.0], yaw)


def draw_poses(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Poses of block, cup and distractor in three strips of the table, so that none overlap."""
    return {
        "block": draw_pose(rng, (-0.10, -0.20), (0.10, -0.12)),
        "cup": draw_pose(rng, (-0.10, 0.12), (0.10, 0.20)),
        "distractor": draw_pose(rng, (-0.12, -0.02), (0.12, 0.02)),
    }


def views_of(poses: dict[str, np.ndarray], T_moved: np.ndarray | None = None) -> dict[str, View]:
    return render([(SHAPES.get(name, DISTRACTOR), T) for name, T in poses.items()], T_moved)


def demonstration(rng: np.random.Generator, wrong: bool = False) -> DemonstrationScene:
    """The cup is grasped at its rim and put on the block; one in a few cues may be plainly wrong."""
    poses = draw_poses(rng)
    grasp = se3.apply(poses["cup"], np.array([[0.03, 0.0, 0.05]]))[0] + rng.normal(0, 0.004, 3)
    release = poses["block"][:3, 3] + [0, 0, 0.12] + rng.normal(0, 0.01, 3)
    if wrong:
        aside = np.array([0.2, 0.0, 0.0])
        grasp, release = release + aside, grasp - aside
    later = poses | {"cup": se3.from_yaw(poses["block"][:3, 3] + [0, 0, 0.05], 0.0)}
    cues = (ContactCue("cup", grasp, "grasp"), ContactCue("block", release, "release"))
    return DemonstrationScene(views_of(poses), cues, views_of(later))


def partly_hidden(scene: DemonstrationScene, name: str, camera: str, share: float) -> DemonstrationScene:
    """The same scene with a grey bar over the right-hand `share` of an object's place in one view."""
    view = scene.views[camera]
    (cue,) = (cue for cue in scene.cues if cue.name == name)
    (half, height, *_), foot = SHAPES[name], cue.point_world * [1, 1, 0]
    corners = foot + np.array([[x, y, z] for x in half for y in half for z in (0, height)]) * [-1, -1, 1]
    uv, _ = project(view.camera, view.T_world_cam, np.vstack([corners, 2 * foot - corners * [1, 1, -1]]))
    low, high = uv.min(axis=0), uv.max(axis=0)
    image = view.image.copy()
    start = round(float(high[0] - share * (high[0] - low[0])))
    image[:, start : round(float(high[0])) + 4] = (90, 90, 95)
    return replace(scene, views=scene.views | {camera: replace(view, image=image)})
