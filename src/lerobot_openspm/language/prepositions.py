"""Prepositional phrases: what relation they mean, and whether they say where to or where from."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.language.constructions import WHICH

Words = tuple[str, ...]
_PHRASES = {
    tuple(phrase.split()): relation for relation, phrases in v.RELATIONS.items() for phrase in phrases
}
_GOALS = {tuple(phrase.split()) for phrase in v.GOALS}
_SOURCES = {tuple(phrase.split()) for phrase in v.SOURCES}
_LONGEST = 4


@dataclass(frozen=True)
class Preposition:
    """A preposition where it stands.

    Attributes:
        relation: What it means, a key of :data:`vocabulary.RELATIONS` or "center"; "" for a bare "from".
        place: Where in the scene, of a phrase that needs no noun ("on the left"): a value of
            :data:`vocabulary.PLACES`; else "".
        is_goal: Whether it says where to ("onto").
        is_source: Whether it says where from ("out of").
        is_relative: Whether it belongs to the noun before it ("that is on").
        is_inside: Whether it says a place within its noun ("in the front of").
        length: How many words it has.
    """

    relation: str
    place: str = ""
    is_goal: bool = False
    is_source: bool = False
    is_relative: bool = False
    is_inside: bool = False
    length: int = 1


def match_preposition(words: Words, at: int) -> Preposition | None:
    """The longest preposition that begins at a word, with the marks and particles before it."""
    start, relative = at, False
    while start < len(words) and (words[start] == WHICH or words[start] in v.PARTICLES):
        relative |= words[start] == WHICH
        direct = _match(words, start) if start == at else None
        if direct and not _longer_after(words, start, direct):  # "right of", "out of"
            return direct
        start += 1
    found = _match(words, start)
    if found is None:
        return None
    return Preposition(
        found.relation,
        found.place,
        found.is_goal,
        found.is_source,
        relative,
        found.is_inside,
        found.length + start - at,
    )


def _longer_after(words: Words, at: int, direct: Preposition) -> bool:
    """Whether a longer one begins behind a particle: "on top of" in "up on top of"."""
    after = _match(words, at + 1)
    return after is not None and after.length + 1 > direct.length


def _match(words: Words, at: int) -> Preposition | None:
    return _source(words, at) or _at_place(words, at) or _in_table(words, at)


def _source(words: Words, at: int) -> Preposition | None:
    """Match "from", alone or with where: "from on top of", "from the left"."""
    length = _longest(words, at, _SOURCES)
    if not length:
        return None
    inner = match_preposition(words, at + length) or _place(words, at + length, length=0)
    if inner is None:
        return Preposition(v.SOURCES[" ".join(words[at : at + length])], is_source=True, length=length)
    return Preposition(inner.relation, inner.place, is_source=True, length=length + inner.length)


def _at_place(words: Words, at: int) -> Preposition | None:
    """Match "on the left", "at the front of", "in the middle of", "in front"."""
    if at >= len(words) or words[at] not in ("on", "at", "in", "into", "to", "toward", "towards", "onto"):
        return None
    found = _place(words, at, length=1, goal=words[at] in ("to", "onto", "into"))
    return replace(found, is_inside=True) if found and words[at] in ("in", "into") else found


def _place(words: Words, at: int, length: int, goal: bool = False) -> Preposition | None:
    end = at + length
    end += end < len(words) and words[end] in ("the", "its", "far", "very")
    end += end < len(words) and words[end] in ("far", "very")
    if end >= len(words) or words[end] not in v.PLACES | v.HEIGHTS or words[at:end] == ("on",):
        return None
    place = v.PLACES.get(words[end]) or v.HEIGHTS[words[end]]
    end += 1
    end += end < len(words) and words[end] == "hand"
    end += end < len(words) and words[end] in ("side", "edge", "end", "part")
    after = words[end] if end < len(words) else ""
    if after == "of" and place in v.RELATION_OF_PLACE:
        return Preposition(v.RELATION_OF_PLACE[place], is_goal=goal, length=end + 1 - at)
    if after and after != "," and match_preposition(words, end) is None:
        return None  # "on the left plate"
    return Preposition("", place, length=end - at)


def _in_table(words: Words, at: int) -> Preposition | None:
    length = _longest(words, at, _PHRASES)
    if not length:
        return None
    phrase = words[at : at + length]
    if phrase == ("on",) and words[at + 1 :] == ("top",):
        return Preposition("on", length=2)  # of what was spoken of
    return Preposition(_PHRASES[phrase], is_goal=phrase in _GOALS, length=length)


def _longest(words: Words, at: int, phrases: dict[Words, str] | set[Words]) -> int:
    return next((n for n in range(_LONGEST, 0, -1) if words[at : at + n] in phrases), 0)
