"""An object known by its shape, and how it is found again.

Candidates come from patches of foreground, by the object's colours or a segmenter's masks. Poses come from
aligning silhouettes. An object that is followed is looked for where it is expected before everywhere else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import intersect_plane
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception import foreground
from lerobot_openspm.perception.objects import records
from lerobot_openspm.perception.objects.base import Look, Record
from lerobot_openspm.perception.objects.shape.colouring import agreement
from lerobot_openspm.perception.objects.shape.fitting import (
    COARSE_CUTS_PX,
    COARSE_PX,
    FINE_CUTS_PX,
    Cloud,
    Evidence,
    Fit,
    PosePrior,
    distinct,
    fit,
    others,
    verdict,
)
from lerobot_openspm.perception.objects.shape.occlusion import behind
from lerobot_openspm.perception.objects.shape.tipped import NEAR_M, has_tipped, lying
from lerobot_openspm.perception.objects.yaw import canonical
from lerobot_openspm.types import UNKNOWN_YAW_STD, PoseEstimate, Support, Symmetry

BLOBS_PER_VIEW = 3
MAX_CANDIDATES = 3
# Candidates with under 20 % of the best one's colour evidence are dropped.
WEAK_SHARE = 0.2
# Candidates that fit less than 70 % as well as the best one are not fitted more finely.
POOR_SHARE = 0.7
# Yaws whose fits are this good, relative to the best one's, and this far apart, are sides to choose among.
SIDES_SHARE, SAME_SIDE_RAD = 0.85, 0.4
# What the agreement of the colours counts beside that of the silhouettes.
COLOURS_SHARE = 3.0
# Visibility is estimated on every 5th point.
SHARE_STEP = 5
# An object that is followed: how far from where it is expected it is looked for before everywhere else, and
# how well it must be seen there for that to be left out.
NEARBY_CUTS_PX = (12.0, 6.0, 4.0, 3.0)
NEARBY_M, NEARBY_HEIGHT_M, NEARBY_RAD = 0.03, 0.003, 0.3
NEARBY_CONFIDENCE = 0.9
# An object this far above or below the plane it was learned on does not stand there.
LIFTED_M = 0.005
# Records: where the object's pixels come from, and the numbers.
COLOURS, SEGMENTER = "colours", "segmenter"
NUMBERS = ("spacing", "height", "yaw_period", "yaw_centre", "yaw_halfwidth", "typical_overlap")
MAX_POINTS = 200_000


@dataclass(frozen=True)
class ShapeModel:
    """An object known by its shape, and by its colours where these tell its pixels.

    Attributes:
        name: The noun phrase.
        log_odds: Foreground log-odds ``(N_BINS,)`` per colour, float32; None where a segmenter finds it.
        points: Surface points ``(n, 3)`` in the object's frame, metres, float32. The frame is upright, its
            origin at the footprint's centre on the support plane.
        spacing: Distance between neighbouring points, metres.
        height: World z of the support plane the object stood on, metres.
        yaw_period: Turning by this angle (radians) leaves the object unchanged; 0 for a body of revolution.
        yaw_centre: Middle of the yaws seen in the demonstrations, radians.
        yaw_halfwidth: Half the width of the range of yaws to search, at most ``yaw_period / 2``, radians.
        typical_overlap: Intersection over union of drawing and mask, median over the demonstrations.
        colours: Colours ``(n, 3)`` of the points, see :func:`learn_colours`, which tell its sides apart; None
            where its yaw is searched in the demonstrated range alone.
    """

    kind: ClassVar[str] = "shape"
    sought_again: ClassVar[bool] = True

    name: str
    log_odds: NDArray[np.float32] | None
    points: NDArray[np.float32]
    spacing: float
    height: float
    yaw_period: float
    yaw_centre: float
    yaw_halfwidth: float
    typical_overlap: float
    colours: NDArray[np.float32] | None = None

    @property
    def radius(self) -> float:
        """Largest distance of a point from the vertical axis, metres."""
        return float(np.linalg.norm(self.points[:, :2], axis=1).max())

    @property
    def cloud(self) -> Cloud:
        """The points, in double precision."""
        return Cloud(self.points.astype(float), self.spacing)

    def search_yaws(self) -> Array:
        """Yaws ``(k,)`` in radians to start a search from, at most about 45 degrees apart."""
        if self.yaw_period == 0:
            return np.zeros(1)
        # Demonstrations that all show one side say nothing of how it stands elsewhere.
        halfwidth = self.yaw_halfwidth if self.colours is None else self.yaw_period / 2
        count = max(1, int(np.ceil(2 * halfwidth / np.deg2rad(46))))
        steps = (np.arange(count) + 0.5) / count * 2 - 1
        return self.yaw_centre + steps * halfwidth

    @property
    def patches(self) -> None:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        return None

    @property
    def symmetry(self) -> Symmetry | None:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        is_one_way = self.yaw_period >= 2 * np.pi
        return None if is_one_way else Symmetry(np.zeros(2), self.yaw_period)

    def localise(self, look: Look) -> PoseEstimate:
        """Find the object: where it is expected, else on its support plane, at any place and learned yaw.

        What other things hide of a place where it is sought tells nothing.
        """
        evidence = _evidence(self, look)
        fits = self._where_expected(look, evidence)
        if not fits:
            prior = PosePrior(yaw=0.0 if self.yaw_period == 0 else np.inf)
            starts = list[tuple[Sequence[Evidence], list[Fit]]]()
            for point in candidates(evidence, self):
                among = behind(look, self.name, self._middle(point))
                own = evidence if among is look else _evidence(self, among)
                poses = [se3.from_yaw(point, yaw) for yaw in self.search_yaws()]
                turned = [fit(own, self.cloud, T, prior, COARSE_CUTS_PX, COARSE_PX) for T in poses]
                starts.append((own, turned))
            enough = POOR_SHARE * max((one.score for _, turned in starts for one in turned), default=0.0)
            for own, turned in starts:
                best = max(one.score for one in turned)
                if best > 0 and best >= enough:
                    fits.append(self._finely(own, turned, prior))
            fits.sort(key=lambda one: -one.score)
            fits = [fits[i] for i in distinct([one.T_world_obj for one in fits], self.radius)]
            if fits and self._has_tipped(evidence, fits[0]):
                return replace(self._estimate(look, evidence, fits), status="not_found", tipped=True)
        return self._estimate(look, evidence, fits)

    def _where_expected(self, look: Look, evidence: Sequence[Evidence]) -> list[Fit]:
        """The fit around where the object is expected, if it is plainly seen there, at least past others."""
        if (T_expected := look.expected.get(self.name)) is None:
            return []
        prior, enough = _nearby(self, T_expected), NEARBY_CONFIDENCE * self.typical_overlap
        there = fit(evidence, self.cloud, T_expected, prior, NEARBY_CUTS_PX)
        if there.score < enough and (among := self._among_others(look, T_expected)) is not look:
            there = fit(_evidence(self, among), self.cloud, T_expected, prior, NEARBY_CUTS_PX)
        return [there] if there.score >= enough else []

    def _among_others(self, look: Look, T_world_obj: Array) -> Look:
        """The look for the object at a pose ``(4, 4)``, behind whatever stands before it."""
        return behind(look, self.name, self._middle(T_world_obj[:3, 3]))

    def _middle(self, point: Array) -> Array:
        """The middle ``(3,)`` of the object standing at a point."""
        return point + np.array([0, 0, float(self.points[:, 2].mean())])

    def _has_tipped(self, evidence: Sequence[Evidence], best: Fit) -> bool:
        """Whether the object lies about where it fits best upright."""
        there = [
            point
            for point in candidates(evidence, self)
            if np.linalg.norm(point[:2] - best.T_world_obj[:2, 3]) < NEAR_M
        ]
        sides = lying(self.cloud, self.yaw_period == 0)
        return has_tipped(evidence, sides, there, best.score, self.typical_overlap)

    def _finely(self, evidence: Sequence[Evidence], turned: Sequence[Fit], prior: PosePrior) -> Fit:
        """The best of the fits at one place, at several yaws, fitted finely.

        Where silhouettes are nearly alike from several sides, the colours of these decide.
        """
        ordered = sorted(turned, key=lambda one: -one.score)
        if (colours := self.colours) is None:
            return fit(evidence, self.cloud, ordered[0].T_world_obj, prior, FINE_CUTS_PX)
        sides = list[Fit]()
        for one in ordered:
            apart = [float(se3.distances(one.T_world_obj, side.T_world_obj)[1]) for side in sides]
            if one.score >= SIDES_SHARE * ordered[0].score and min(apart, default=np.inf) > SAME_SIDE_RAD:
                sides.append(one)
        fits = [fit(evidence, self.cloud, one.T_world_obj, prior, FINE_CUTS_PX) for one in sides]
        shown = [agreement(evidence, self.cloud, colours, one.T_world_obj) for one in fits]
        worth = [one.score + COLOURS_SHARE * share for one, share in zip(fits, shown, strict=True)]
        return fits[int(np.argmax(worth))]

    def _estimate(self, look: Look, evidence: Sequence[Evidence], fits: Sequence[Fit]) -> PoseEstimate:
        """What fits at distinct places say, the best first."""
        T_expected, points = look.expected.get(self.name), self.cloud.points[::SHARE_STEP]
        if not fits:
            visible = 1.0 if T_expected is None else self._visible(look, T_expected)
            ignorance = np.diag([1.0, 1.0, 1.0, UNKNOWN_YAW_STD**2])
            return PoseEstimate("not_found", np.eye(4), ignorance, 0.0, visible)
        scores = [one.score for one in fits]
        status, confidence = verdict(scores, self.typical_overlap)
        if T_expected is None or status == "found":
            visible = look.seen_share(se3.apply(fits[0].T_world_obj, points))
        else:
            visible = self._visible(look, T_expected)
        covariance = fits[0].covariance.copy()
        if self.yaw_period == 0:
            covariance[3, :] = covariance[:, 3] = 0
            covariance[3, 3] = UNKNOWN_YAW_STD**2
        poses = [canonical(one.T_world_obj, self.yaw_period, self.yaw_centre) for one in fits]
        alike = tuple(poses[1 : 1 + others(scores, self.typical_overlap)])
        support = _support(self, evidence, fits[0])
        return PoseEstimate(status, poses[0], covariance, confidence, visible, support, alike)

    def _visible(self, look: Look, T_expected: Array) -> float:
        """How much of the object could be seen where it is expected ``(4, 4)``, past the hand and others."""
        points = se3.apply(T_expected, self.cloud.points[::SHARE_STEP])
        return self._among_others(look, T_expected).seen_share(points)

    def to_record(self) -> Record:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        source = SEGMENTER if self.log_odds is None else COLOURS
        fields = {"kind": self.kind, "foreground": source, "name": self.name}
        arrays = {"points": self.points.astype(np.float32)}
        if self.log_odds is not None:
            arrays = {"log_odds": self.log_odds.astype(np.float32), **arrays}
        if self.colours is not None:
            arrays = {**arrays, "colours": self.colours.astype(np.float32)}
        return fields | {name: float(getattr(self, name)) for name in NUMBERS}, arrays


def from_record(fields: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], where: str) -> ShapeModel:
    """Inverse of :meth:`ShapeModel.to_record`. Raises MemoryFormatError, which names ``where``."""
    name, source = fields["name"], fields.get("foreground")
    if source not in (COLOURS, SEGMENTER):
        raise MemoryFormatError(
            f"{where}: 'foreground' of {name!r} is {source!r}, expected {COLOURS} or {SEGMENTER}"
        )
    numbers = records.numbers(fields, NUMBERS, where)
    log_odds = records.array(arrays, "log_odds", (foreground.N_BINS,), where) if source == COLOURS else None
    points = records.points(arrays, where, MAX_POINTS)
    shown = records.array(arrays, "colours", points.shape, where) if "colours" in arrays else None
    return ShapeModel(name, log_odds, points, **numbers, colours=shown)


def _evidence(model: ShapeModel, look: Look) -> list[Evidence]:
    """Every view with the foreground probability of the object's pixels, and what of it is in sight."""
    evidence = []
    for camera, view in look.views.items():
        hidden = look.hidden.get(camera)
        visible = None if hidden is None else 1 - hidden.astype(np.float32)
        if model.log_odds is not None:
            evidence.append(
                Evidence(view, foreground.probability(look.bins(camera), model.log_odds), visible)
            )
            continue
        mask = np.zeros(view.image.shape[:2], np.float32)
        for one in look.instances_of(model.name).get(camera, ()):
            mask[one.mask] = 1.0
        evidence.append(Evidence(view, mask, visible, camera))
    return evidence


def _nearby(model: ShapeModel, T_expected: Array) -> PosePrior:
    """An object that is followed keeps about its yaw, and its height but for one in the air."""
    is_lifted = abs(float(T_expected[2, 3]) - model.height) > LIFTED_M
    return PosePrior(
        NEARBY_M, NEARBY_HEIGHT_M if is_lifted else 0.0, 0.0 if model.yaw_period == 0 else NEARBY_RAD
    )


def _support(model: ShapeModel, evidence: Sequence[Evidence], best: Fit) -> Support:
    """What a fit rests on: views that explain the mask equally well are consistent."""
    seen = best.overlaps[np.isfinite(best.overlaps)]
    consistency = float(seen.min() / max(seen.max(), 1e-6)) if len(seen) else 0.0
    area = float(sum(np.count_nonzero(one.probability > 0.5) for one in evidence))
    return Support(model.kind, area, consistency, model.typical_overlap)


def candidates(evidence: Sequence[Evidence], model: ShapeModel) -> list[Array]:
    """Places ``(3,)`` of the object's origin that patches of its colours suggest, the most likely first."""
    votes: list[tuple[Array, float]] = []
    middle = model.height + float(model.points[:, 2].mean())
    for one in evidence:
        for blob in foreground.find_blobs(one.probability, 12, BLOBS_PER_VIEW):
            point = intersect_plane(one.view.camera, one.view.T_world_cam, blob.centre, middle)
            distance = float(np.linalg.norm(point - one.view.T_world_cam[:3, 3]))
            expected = (one.view.camera.focal_px / distance) ** 2 * model.points.std(axis=0)[:2].prod() * 12
            # The pixel that the plane's point comes from must lie ahead of the camera, not behind it.
            if (point - one.view.T_world_cam[:3, 3]) @ one.view.T_world_cam[:3, 2] > 0:
                votes.append((point, min(blob.area / max(expected, 1.0), 1.0) * (1.0 if blob.whole else 0.3)))
    places: list[Array] = []
    strength: list[float] = []
    for point, weight in sorted(votes, key=lambda vote: -vote[1]):
        near = [
            i for i, place in enumerate(places) if np.linalg.norm(place[:2] - point[:2]) < 0.6 * model.radius
        ]
        if near:
            i = near[0]
            places[i] = (places[i] * strength[i] + point * weight) / (strength[i] + weight)
            strength[i] += weight
        else:
            places.append(point)
            strength.append(weight)
    order = np.argsort(-np.array(strength), kind="stable")[:MAX_CANDIDATES]
    order = [i for i in order if strength[i] >= WEAK_SHARE * max(strength)]
    return [np.array([places[i][0], places[i][1], model.height]) for i in order]
