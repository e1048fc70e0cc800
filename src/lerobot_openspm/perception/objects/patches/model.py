"""An object that hardly moves between demonstrations, known by patches of their images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects import records
from lerobot_openspm.perception.objects.base import Look, Record
from lerobot_openspm.perception.objects.patches.match import (
    REACH_M,
    Patch,
    Picture,
    Probe,
    as_seen,
    is_covered,
    match,
    resized,
)
from lerobot_openspm.types import UNKNOWN_YAW_STD, PoseEstimate, Support, View

# A patch is looked for at the height it was learned at; an object this much above or below is another matter.
MAX_LIFT_M = 0.005
# Probes whose places differ by this much are 1/e consistent.
CONSISTENT_M = 0.005
# Of the typical correlation.
FOUND_CORRELATION = 0.5
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
MAX_PROBES, MAX_PIXELS = 64, 4096


@dataclass(frozen=True)
class PatchModel:
    """An object known by patches. Its frame has the world's axes and stands where the hand touched it.

    Attributes:
        name: The noun phrase.
        probes: What to look for where, the best first.
        height: World z of the reference point, metres; it is not measured.
        typical_correlation: Of the patches in the demonstrations.
    """

    kind: ClassVar[str] = "patches"
    sought_again: ClassVar[bool] = False

    name: str
    probes: tuple[Probe, ...]
    height: float
    typical_correlation: float

    @property
    def yaw_period(self) -> float:
        """A full turn: the object is not known to look alike from any two sides."""
        return 2 * np.pi

    @property
    def points(self) -> Array:
        """None: patches have no shape."""
        return np.zeros((0, 3))

    @property
    def patches(self) -> PatchModel:
        """Itself: only what hardly moves is known by patches."""
        return self

    @property
    def symmetry(self) -> None:
        """None: patches have no shape."""
        return None

    def localise(self, look: Look) -> PoseEstimate:
        """Find the object near its demonstrated places; out of the patches' reach nothing can be said of it.

        Views of a camera that has moved since the patches were cut do not help, nor do patches that may be
        hidden.
        """

        def resize(view: View, size: tuple[int, int]) -> Picture:  # once for all objects and probes
            return look.prepared((id(view), size), partial(resized, view, size))

        stds, places, correlations, area_px = [], [], [], 0.0
        for probe in self.probes:
            view = as_seen(look.views.get(probe.camera), probe, resize)
            covered = look.hidden.get(probe.camera)
            if view is None or (covered is not None and is_covered(probe, covered)):
                continue
            found = [match(patch, probe, view) for patch in probe.patches]
            if sights := [one for one in found if one is not None]:
                stds.append(probe.std_m)
                places.append(np.median([one.point_world[:2] for one in sights], axis=0))
                correlations.append(float(np.median([one.correlation for one in sights])))
                area_px += float(np.mean([patch.image[..., 0].size for patch in probe.patches]))
        if not correlations:
            return unseen()
        return self._estimate(stds, places, correlations, area_px, look.expected.get(self.name))

    def _estimate(
        self,
        stds: list[float],
        places: list[Array],
        correlations: list[float],
        area_px: float,
        T_expected: Array | None,
    ) -> PoseEstimate:
        """What the probes say together: standard deviation, place ``(2,)`` and correlation of each."""
        information, weighted = np.zeros((2, 2)), np.zeros(2)
        for std_m, own in zip(stds, places, strict=True):
            weight = np.eye(2) / std_m**2
            information += weight
            weighted += weight @ own
        is_found = np.mean(correlations) >= FOUND_CORRELATION * self.typical_correlation
        confidence = float(np.clip(np.mean(correlations) / max(self.typical_correlation, 1e-3), 0, 1))
        # Height and direction are taken to be the demonstrated ones; they are not measured.
        covariance = np.diag([0.0, 0.0, REACH_M**2, UNKNOWN_YAW_STD**2])
        # The probes look at the same pixels and err together: many are no surer than one.
        covariance[:2, :2] = len(correlations) * np.linalg.inv(information)
        place = np.linalg.solve(information, weighted)
        T_world_obj = se3.from_yaw(np.append(place, self.height), 0.0)
        apart = np.linalg.norm(np.stack(places) - place, axis=1).max()
        quality = float(np.clip(self.typical_correlation, 0, 1))
        support = Support(self.kind, area_px, float(np.exp(-apart / CONSISTENT_M)), quality)
        status, visible = (
            "found" if is_found else "not_found",
            float(self._can_tell(bool(is_found), T_expected)),
        )
        return PoseEstimate(status, T_world_obj, covariance, confidence, visible, support)

    def _can_tell(self, is_found: bool, T_expected: Array | None) -> bool:
        """Whether patches say anything of an object that is expected somewhere.

        A lifted object looks like one that has moved sideways, and what is expected out of the patches' reach
        is not missed there.
        """
        if T_expected is None:
            return True
        if abs(T_expected[2, 3] - self.height) > MAX_LIFT_M:
            return False
        return is_found or self.reaches(T_expected)

    def reaches(self, T_world_obj: Array, margin_m: float = 0.0) -> bool:
        """Whether an object at a pose ``(4, 4)`` is where patches are sought, or so far beyond."""
        places = np.stack([patch.point_world[:2] for probe in self.probes for patch in probe.patches])
        away_m = np.linalg.norm(places - T_world_obj[:2, 3], axis=1).min()
        return bool(away_m <= REACH_M + margin_m)

    def to_record(self) -> Record:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        probes, arrays = [], {}
        for i, probe in enumerate(self.probes):
            probes.append({"camera": probe.camera, "std_m": probe.std_m})
            intrinsics = [getattr(probe.calibration, name) for name in INTRINSICS]
            arrays[f"{i}.calibration"] = np.array(intrinsics, float)
            arrays[f"{i}.T_world_cam"] = probe.T_world_cam.astype(float)
            arrays[f"{i}.corners"] = np.stack([patch.corner for patch in probe.patches]).astype(float)
            arrays[f"{i}.points"] = np.stack([patch.point_world for patch in probe.patches]).astype(float)
            for j, patch in enumerate(probe.patches):
                arrays[f"{i}.patch.{j}"] = patch.image
        fields = {"height": self.height, "typical_correlation": self.typical_correlation, "probes": probes}
        return {"kind": self.kind, "name": self.name, **fields}, arrays


def unseen() -> PoseEstimate:
    """What is told of an object that can be sought nowhere."""
    unknown = np.diag([1.0, 1.0, 1.0, UNKNOWN_YAW_STD**2])
    return PoseEstimate("not_found", np.eye(4), unknown, 0.0, visible=0.0)


def from_record(fields: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], where: str) -> PatchModel:
    """Inverse of :meth:`PatchModel.to_record`. Raises MemoryFormatError, which names ``where``."""
    name, rows = fields["name"], fields.get("probes")
    if not isinstance(rows, list) or not 1 <= len(rows) <= MAX_PROBES:
        raise MemoryFormatError(f"{where}: 'probes' of {name!r} must be a list of 1 to {MAX_PROBES} objects")
    probes = tuple(_probe(row, i, arrays, where) for i, row in enumerate(rows))
    return PatchModel(name, probes, **records.numbers(fields, ("height", "typical_correlation"), where))


def _probe(row: Any, index: int, arrays: Mapping[str, NDArray[Any]], where: str) -> Probe:
    if not isinstance(row, Mapping) or not isinstance(row.get("camera"), str):
        raise MemoryFormatError(f"{where}: probe {index} has no 'camera'; learn the objects again")
    intrinsics = records.array(arrays, f"{index}.calibration", (len(INTRINSICS),), where, np.float64)
    width, height, fx, fy, cx, cy = (float(number) for number in intrinsics)
    T_world_cam = records.array(arrays, f"{index}.T_world_cam", (4, 4), where, np.float64)
    if not (1 <= width <= MAX_PIXELS and 1 <= height <= MAX_PIXELS and fx != 0 and fy > 0):
        raise MemoryFormatError(f"{where}: the camera of probe {index} has impossible intrinsics")
    if not se3.is_rigid(T_world_cam):
        raise MemoryFormatError(f"{where}: the camera of probe {index} has no rigid pose")
    camera = Camera(int(width), int(height), fx, fy, cx, cy, "world", T_world_cam)
    corners = records.array(arrays, f"{index}.corners", (-1, 2), where, np.float64)
    points = records.array(arrays, f"{index}.points", (len(corners), 3), where, np.float64)
    if len(corners) == 0:
        raise MemoryFormatError(f"{where}: probe {index} has no patches; learn the objects again")
    patches = []
    for j, (corner, point) in enumerate(zip(corners, points, strict=True)):
        image = records.array(arrays, f"{index}.patch.{j}", (-1, -1, 3), where, np.uint8)
        end = np.add(corner, [image.shape[1], image.shape[0]])
        if min(image.shape) < 1 or (corner < 0).any() or (end > [width, height]).any():
            raise MemoryFormatError(f"{where}: patch {j} of probe {index} does not lie in its image")
        patches.append(Patch(image, corner, point))
    std_m = records.number(row, "std_m", 1e-9, 1.0, where)
    return Probe(row["camera"], camera, T_world_cam, tuple(patches), std_m)
