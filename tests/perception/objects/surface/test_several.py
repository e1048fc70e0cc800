"""Several of a kind are each found once, and so is one that words tell from the others."""

import numpy as np
import pytest
from tests.perception.drawn_world import SHAPES, hand_camera, render
from tests.perception.objects.surface.filmed import HOME, MIDDLES, looking_down, views_at

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.objects.base import Look
from lerobot_openspm.perception.objects.surface.learn import _agreements
from lerobot_openspm.perception.objects.surface.search import Place, distinct
from lerobot_openspm.perception.pipeline import detect


def test_of_what_words_tell_apart_every_one_is_found(models):
    usual = se3.from_yaw((*MIDDLES["cup"][:2], 0.0), 0.0)
    other = se3.from_yaw([-0.1, -0.12, 0.0], 0.0)
    views = render([(SHAPES["cup"], usual), (SHAPES["cup"], other)], None, hand_camera(looking_down(*HOME)))
    assert models["cup"].localise(Look(views)).others == ()
    assert [len(detect(views, models, None, told)["cup"].others) for told in ((), ("cup",))] == [0, 1]
    found = models["cup"].localise(Look(views, told_apart=("cup",)))
    places = sorted((T[:2, 3] for T in (found.T_world_obj, *found.others)), key=lambda place: place[1])
    away = models["cup"].localise(Look(views)).T_world_obj[:2, 3] - usual[:2, 3]
    assert len(places) == 2
    for place, T in zip(places, (other, usual), strict=True):
        assert place == pytest.approx(T[:2, 3] + away, abs=0.008)


def test_a_place_is_told_once_however_often_it_was_found(models):
    surface = models["cup"].surface
    poses = [np.array([x, 0.1, 0.0, 0.0]) for x in (0.0, 0.01, 0.12, 0.13)]
    places = [Place(pose, score) for pose, score in zip(poses, (0.9, 0.8, 0.7, 0.6), strict=True)]
    assert [place.score for place in distinct(surface, places)] == [0.9, 0.7]


def test_another_one_is_told_once_and_not_hidden_by_one_that_is_not_seen_well(models):
    cup = models["cup"]
    look = Look(views_at({}, looking_down(*HOME)))
    poses = [np.array([x, 0.1, cup.height, 0.0]) for x in (-0.1, 0.09, 0.10, 0.11)]
    shares = zip(poses, (1.0, 0.5, 0.95, 0.9), strict=True)
    places = [Place(pose, share * cup.typical_agreement) for pose, share in shares]
    (other,) = cup._estimate(look, cup._sights(look), places).others
    assert other[:3, 3] == pytest.approx(poses[2][:3])


def test_of_those_that_words_tell_apart_others_need_not_be_seen_as_well(models):
    cup, pose = models["cup"], np.array([0.0, 0.1, models["cup"].height, 0.0])
    best = Place(pose, 1.3 * cup.typical_agreement)
    for told_apart, least in ((True, 0.7), (False, 0.85 * 1.3)):
        assert cup._is_another(Place(pose, (least + 0.01) * cup.typical_agreement), best, told_apart)
        assert not cup._is_another(Place(pose, (least - 0.01) * cup.typical_agreement), best, told_apart)


def test_others_of_a_kind_that_words_tell_apart_do_not_raise_what_is_asked(models):
    cup, usual = models["cup"], se3.from_yaw((*MIDDLES["cup"][:2], 0.0), 0.0)
    cups = [(SHAPES["cup"], T) for T in (usual, se3.from_yaw([-0.1, -0.12, 0.0], 0.0))]
    alone, both = (render(own, None, hand_camera(looking_down(*HOME))) for own in (cups[:1], cups))
    T = cup.localise(Look(alone)).T_world_obj
    (own, without), (same, another), (_, neither) = (
        _agreements(cup.surface, [(views, T)], cup.backdrop, are_several)
        for views, are_several in ((alone, False), (both, False), (both, True))
    )
    assert own == pytest.approx(same, abs=0.05)
    assert another > 0.8 * own
    assert neither == pytest.approx(without, abs=0.05)


def test_two_of_a_kind_where_neither_was_shown_are_both_found_without_words(models):
    cups = [(SHAPES["cup"], se3.from_yaw(place, 0.0)) for place in ([0.12, 0.12, 0.0], [-0.1, -0.12, 0.0])]
    views = render(cups, None, hand_camera(looking_down(*HOME)))
    assert len(models["cup"].localise(Look(views)).others) == 1
