"""An object known by its surface, which is found wherever it stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Look, Record
from lerobot_openspm.perception.objects.patches.model import PatchModel, unseen
from lerobot_openspm.perception.objects.surface.backdrop import Backdrop
from lerobot_openspm.perception.objects.surface.compare import FINE_POINTS, score_at
from lerobot_openspm.perception.objects.surface.earlier import share_if_there, sights_before
from lerobot_openspm.perception.objects.surface.search import (
    FINE_STEPS,
    SAME_PLACE_M,
    Freedom,
    Place,
    are_apart,
    covariance_at,
    distinct,
    likelihood,
    over_supports,
    over_table,
    refine,
    search,
    settle,
)
from lerobot_openspm.perception.objects.surface.shown import KEPT_SHARE, seen_where_shown, visible_share
from lerobot_openspm.perception.objects.surface.sight import Sight, Surface, sight_of
from lerobot_openspm.perception.objects.surface.tipped import has_tipped, lying
from lerobot_openspm.types import PoseEstimate, Symmetry

# In a record, the colour of points that have none.
UNCOLOURED = -1000.0
# An object is found from here on between what agrees at most where it is not, and what is typical of it;
# and with less than this share of the typical agreement it is never.
FOUND_BETWEEN, LEAST_SHARE = 0.35, 0.55
# Patches that find an object where it stood in the demonstrations are believed from this share on.
BELIEVED_SHARE = 0.8
# A second place that explains the pictures nearly as well makes the first one doubtful.
RIVAL_SHARE = 0.93
# An object whose pattern tells nothing is at most this sure: it may be turned, or something alike.
WITHOUT_PATTERN = 0.9
# A place that agrees this well holds another of the kind; where words tell several apart, there are others.
ANOTHER_SHARE, TOLD_APART_SHARE = 0.85, 0.7
# Patches that find an object this near to where it is expected are not checked again, metres.
FOLLOWED_M = 0.02
# An object that is expected this much above the table is in the hand, metres.
LIFTED_M = 0.02
# Expected this much above the table, but less than LIFTED_M, it may stand on something low: its height is
# sought too. Metres.
RAISED_M = 0.005
# Of the typical agreement around where an object is expected: below this it is gone; from KEPT_SHARE on it is
# seen there; in between something may hide it.
GONE_SHARE = 0.4
# That it is where it was expected needs less evidence, if the pictures tell its place as sharply as this:
# from this share on nothing is in doubt. What tells it more vaguely than that is no evidence. Metres.
SURE_SHARE, SHARP_M, VAGUE_M = 0.8, 0.004, 0.008
# Earlier looks count as long as the place by all of them agrees with the present look by this share of what
# the best place by that alone does.
STILL_SHARE = 0.85
# Directions that the search begins from, for an object that does not look alike from all of them.
YAWS = tuple(np.linspace(0, 2 * np.pi, 8, endpoint=False))
# An object that agrees less than this share with its best place on the table may stand on something. That is
# believed if it agrees this share, and the place on the table less than this share as well.
CLEAR_SHARE, RAISED_SHARE, BETTER_SHARE = 0.9, 0.85, 0.93
# What stands upright nowhere has tipped if it agrees by so much more than to be found, and is half in view.
TIPPED_MORE, TIPPED_SEEN_SHARE = 0.05, 0.5


@dataclass(frozen=True)
class SurfaceModel:
    """An object known by its surface; where it stood in the demonstrations, by patches too.

    Attributes:
        name: The noun phrase.
        surface: Its points, in its own frame.
        backdrop: What no object is.
        height: World z of its frame when it stands on the table, metres.
        typical_agreement: How well the demonstrations' first pictures agree with its surface.
        rival_agreement: How well they agree with it elsewhere at most, where it is not.
        near: Patches, more exact where it stood in demonstrations; None of what first pictures show badly.
        shown: Where it stood (x, y, z), unless patches find it all over; how well pictures agreed ``(k, 4)``.
    """

    kind: ClassVar[str] = "surface"
    sought_again: ClassVar[bool] = True

    name: str
    surface: Surface
    backdrop: Backdrop
    height: float
    typical_agreement: float
    rival_agreement: float
    near: PatchModel | None
    shown: Array = field(default_factory=lambda: np.zeros((0, 4)))

    @property
    def yaw_period(self) -> float:
        """A full turn: yaw is told from the demonstrated direction."""
        return 2 * np.pi

    @property
    def points(self) -> Array:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        return self.surface.coloured

    @property
    def patches(self) -> PatchModel | None:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        return self.near

    @property
    def symmetry(self) -> Symmetry | None:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        return self.surface.symmetry

    @property
    def found_share(self) -> float:
        """The share of the typical agreement from which on it is found."""
        rival = self.rival_agreement / self.typical_agreement
        return max(LEAST_SHARE, rival + FOUND_BETWEEN * (1 - rival))

    def localise(self, look: Look) -> PoseEstimate:
        """Find the object: where it stood in the demonstrations, where it is expected, or anywhere."""
        expected = look.expected.get(self.name)
        there = None if expected is None or not self._is_away(expected) else self._at(look, expected)
        # What falls out of the hand looks like one at its height that slides away.
        is_there = there is not None and _apart_m(there.T_world_obj, expected) < SAME_PLACE_M
        if there is not None and is_there and (followed := _followed(there)).status == "found":
            return followed
        near = self._where_shown(look) if self.near is None else self.near.localise(look)
        if expected is not None and self._is_lifted(expected):
            return near  # in the hand, or where that put it, it is hidden more often than gone
        if near.status == "found" and _apart_m(near.T_world_obj, expected) < FOLLOWED_M:
            return near
        is_told_apart = self.name in look.told_apart
        if near.status == "found" and expected is None and self.near is None and not is_told_apart:
            return near
        sights = self._sights(look)
        if is_told_apart and expected is None:
            found = self._estimate(look, sights, self._all_places(look, sights), told_apart=True)
            return self._unless_tipped(look, sights, found)
        is_seen = near.status == "found"
        near_score = score_at(self.surface, sights, _pose(near.T_world_obj)) if is_seen else 0.0
        is_near = near_score >= BELIEVED_SHARE * self.typical_agreement
        # Of two alike, another one may stand where this one was shown.
        if is_near and (expected is None or not is_told_apart):
            return near
        if expected is not None:
            there = there or self._at(look, expected)
            typical = self.typical_agreement
            due = share_if_there(look, self.name, self.surface, typical, expected, self._sights)
            if there.confidence >= GONE_SHARE * due:
                return _followed(there)
        if is_near:
            return near
        places = self._anywhere(look, sights)
        # Something may stand on it.
        if near_score > max(BETTER_SHARE * places[0].score, GONE_SHARE * self.typical_agreement):
            return replace(near, confidence=min(near.confidence, near_score / self.typical_agreement))
        found = self._estimate(look, sights, places)
        if found.status == "found":
            return found
        found = self._unless_tipped(look, sights, found)
        if expected is None or self.near is None:
            return found
        # Where its patches cannot tell that it is gone, it may be hidden.
        return replace(found, visible=min(found.visible, near.visible))

    def _where_shown(self, look: Look) -> PoseEstimate:
        """Where the demonstrations showed it, if first pictures show it there as they did."""
        sights = self._sights(look)
        seen = seen_where_shown(self.surface, sights, self.shown, self._freedom)
        if not seen:
            return unseen()
        places = sorted((place for place, _ in seen), key=lambda place: -place.score)
        others = tuple(one.T_world_obj for one in distinct(self.surface, places)[1:])
        return replace(self._estimate(look, sights, places[:1]), status="found", others=others)

    def _is_lifted(self, T_expected: Array) -> bool:
        return bool(T_expected[2, 3] - self.height > LIFTED_M)

    def _may_be_raised(self, T_expected: Array) -> bool:
        return bool(RAISED_M < T_expected[2, 3] - self.height <= LIFTED_M)

    def _is_away(self, T_expected: Array) -> bool:
        """Whether its patches cannot show it where it is expected."""
        if self.near is None or self._is_lifted(T_expected):
            return True
        return not self.near.reaches(T_expected, FOLLOWED_M)

    def _at(self, look: Look, T_expected: Array) -> PoseEstimate:
        """What is seen of it around where it is expected.

        The place is that by earlier looks too, as long as it explains the present one nearly as well as the
        best place by that alone does: a look from nearby shows only a part, and tells the place badly.
        """
        sights = self._sights(look)
        freedom = replace(self._freedom, lifts=self._may_be_raised(T_expected))
        seen = settle(self.surface, sights, _pose(T_expected), freedom)
        if before := sights_before(look, self.name, T_expected, self._sights):
            together = sights | before
            still = refine(self.surface, together, _pose(T_expected), freedom, FINE_POINTS, FINE_STEPS)
            score = score_at(self.surface, sights, still.pose)
            if score >= STILL_SHARE * seen.score:
                seen = replace(still, score=score)
        return self._estimate(look, sights, [seen])

    def _sights(self, look: Look) -> dict[str, Sight]:
        """The views as surfaces are compared with them, prepared once for all objects."""
        return {
            camera: look.prepared((camera, self.backdrop.key), partial(self._sight, look, camera))
            for camera in look.views
        }

    def _sight(self, look: Look, camera: str) -> Sight:
        return sight_of(look.views[camera], camera, self.backdrop, look.hidden.get(camera))

    def _anywhere(self, look: Look, sights: Mapping[str, Sight]) -> list[Place]:
        """The most likely places: on the table, else on other things."""
        key = (self.name, id(self))
        table = look.prepared((*key, "table"), partial(self._on_table, sights))
        if table[0].score >= CLEAR_SHARE * self.typical_agreement:
            return table
        if len(look.supports):
            on_things = self._on_things(look.supports, sights)
            if on_things and BETTER_SHARE * on_things[0].score > table[0].score:
                return on_things
        return table

    def _all_places(self, look: Look, sights: Mapping[str, Sight]) -> list[Place]:
        """Places on the table, on other things and where it was shown; several may hold one of the kind."""
        places = self._on_table(sights, several=True)
        shown = seen_where_shown(self.surface, sights, self.shown, self._freedom)
        places += [replace(one, score=min(share, 1.0) * self.typical_agreement) for one, share in shown]
        if len(look.supports):
            places += self._on_things(look.supports, sights, several=True)
        return sorted(places, key=lambda place: -likelihood(self.surface, place))

    def _on_table(self, sights: Mapping[str, Sight], several: bool = False) -> list[Place]:
        ground = over_table(self.surface, self.backdrop.reach, self.height)
        return search(self.surface, sights, ground, self._yaws, self._freedom, several)

    def _on_things(self, supports: Array, sights: Mapping[str, Sight], several: bool = False) -> list[Place]:
        table = self.backdrop.table_height
        ground = over_supports(self.surface, supports, table, self.height - table)
        low, high = self.backdrop.reach
        ground = ground[((ground[:, :2] > low) & (ground[:, :2] < high)).all(1)]
        if len(ground) == 0:
            return []
        lifts = replace(self._freedom, lifts=True)
        places = search(self.surface, sights, ground, self._yaws, lifts, several)
        return [one for one in places if one.score >= self._needed(one) * self.typical_agreement]

    def _needed(self, place: Place) -> float:
        """The share of the typical agreement from which on it is found at a place."""
        is_raised = place.pose[2] > self.height + LIFTED_M / 2
        return max(self.found_share, RAISED_SHARE) if is_raised else self.found_share

    def _unless_tipped(self, look: Look, sights: Mapping[str, Sight], found: PoseEstimate) -> PoseEstimate:
        """The estimate, which says where there is none whether the object lies on the table."""
        if found.status != "not_found" or found.visible < TIPPED_SEEN_SHARE:
            return found
        sides, table = lying(self.surface), self.backdrop.table_height
        needed = (self.found_share + TIPPED_MORE) * self.typical_agreement
        told = partial(has_tipped, sides, sights, self.backdrop.reach, table, YAWS, needed)
        return replace(found, tipped=look.prepared((self.name, id(self), "tipped"), told))

    @property
    def _yaws(self) -> tuple[float, ...]:
        return YAWS[:1] if self.surface.is_round else YAWS

    @property
    def _freedom(self) -> Freedom:
        return Freedom(not self.surface.is_round)

    def _estimate(
        self, look: Look, sights: Mapping[str, Sight], places: list[Place], told_apart: bool = False
    ) -> PoseEstimate:
        best = places[0]
        share = best.score / self.typical_agreement
        rivals = [one for one in places[1:] if are_apart(self.surface, one, best)]
        most = RIVAL_SHARE * likelihood(self.surface, best)
        is_rivalled = any(likelihood(self.surface, one) > most for one in rivals)
        status = "not_found" if share < self._needed(best) else "ambiguous" if is_rivalled else "found"
        T = best.T_world_obj
        covariance = covariance_at(self.surface, sights, best.pose, not self.surface.is_round)
        own = se3.apply(T, self.surface.coloured)
        visible = visible_share(look, own) if self.near is None else look.seen_share(own)
        more = [one for one in rivals if self._is_another(one, best, told_apart)]
        others = tuple(one.T_world_obj for one in distinct(self.surface, more))
        sure = WITHOUT_PATTERN + (1 - WITHOUT_PATTERN) * self.surface.pattern
        return PoseEstimate(status, T, covariance, sure * float(np.clip(share, 0, 1)), visible, None, others)

    def _is_another(self, place: Place, best: Place, told_apart: bool) -> bool:
        """Whether another one of the kind stands at a place: it is nearly as well seen as the best one."""
        if told_apart:
            return place.score >= TOLD_APART_SHARE * self.typical_agreement
        return place.score >= ANOTHER_SHARE * max(self.typical_agreement, best.score)

    def to_record(self) -> Record:
        """See :class:`lerobot_openspm.perception.objects.base.KnownObject`."""
        near_fields, near_arrays = (None, {}) if self.near is None else self.near.to_record()
        table = self.backdrop.table
        fields = {
            "kind": self.kind, "name": self.name, "height": self.height,
            "typical_agreement": self.typical_agreement, "rival_agreement": self.rival_agreement,
            "spacing": self.surface.spacing, "pattern": self.surface.pattern,
            "table_height": self.backdrop.table_height, "hand_cameras": list(self.backdrop.hand),
            "near": near_fields,
        }  # fmt: skip
        arrays: dict[str, NDArray[Any]] = {
            "points": self.surface.points.astype(np.float32),
            "normals": self.surface.normals.astype(np.float32),
            "colours": np.nan_to_num(self.surface.colours, nan=UNCOLOURED).astype(np.float32),
            "table_colour": np.vstack([table.mean[None], table.precision]).astype(np.float32),
            "table_area": self.backdrop.table_area.astype(np.float32),
            "shown": self.shown,
        }
        for i, mask in enumerate(self.backdrop.hand.values()):
            arrays[f"hand.{i}"] = mask.astype(np.uint8)
        return fields, arrays | {f"near.{key}": value for key, value in near_arrays.items()}


def _followed(seen: PoseEstimate) -> PoseEstimate:
    """What is seen around where an object was expected, as far as the pictures can tell."""
    std_m = float(np.sqrt(seen.covariance[:2, :2].diagonal().max()))
    if seen.confidence < KEPT_SHARE or std_m > VAGUE_M:
        return replace(seen, status="not_found", visible=0.0)
    if std_m <= SHARP_M:
        seen = replace(seen, confidence=min(1.0, seen.confidence / SURE_SHARE))
    return seen


def _apart_m(T: Array, other: Array | None) -> float:
    return np.inf if other is None else float(np.linalg.norm(T[:3, 3] - other[:3, 3]))


def _pose(T_world_obj: Array) -> Array:
    return np.array([*T_world_obj[:3, 3], se3.yaw_of(T_world_obj)])
