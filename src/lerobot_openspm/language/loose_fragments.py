"""Fragments of a sentence, with the things, phrases and cues in each: what stands between its joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.language.loose_words import Element
from lerobot_openspm.language.nouns import Noun
from lerobot_openspm.language.prepositions import Preposition
from lerobot_openspm.language.sense import MADE


@dataclass
class Phrase:
    """A preposition with its nouns."""

    preposition: Preposition
    nouns: list[Noun] = field(default_factory=list[Noun])
    is_reference: bool = False


@dataclass
class Fragment:
    """What stands between two joints.

    Attributes:
        marker: How it is joined to what is before: "", ";", ",", "and", "then", "after", "before".
        nouns: Things without a preposition.
        phrases: The others.
        operation: What is to be done, by its cue; "" without one.
        is_wish, is_state, is_first: Whether it says so; whether it says how things are; whether it is to be
            done first.
    """

    marker: str = ""
    nouns: list[Noun] = field(default_factory=list[Noun])
    phrases: list[Phrase] = field(default_factory=list[Phrase])
    operation: str = ""
    is_wish: bool = False
    is_state: bool = False
    is_first: bool = False
    is_seen: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether it says nothing."""
        return not (self.nouns or self.phrases or self.operation)


def read_fragments(elements: Sequence[Element]) -> list[Fragment]:
    """Split elements at their joints; empty fragments are left out."""
    fragments = [Fragment()]
    is_relative = False
    for i, element in enumerate(elements):
        one = fragments[-1]
        if element.kind == "joint":
            if element.value == "first":
                one.is_first = True
            elif element.value == "last" or _joins_pair(one, element):
                continue
            elif one.is_empty:
                one.marker = element.value if element.value not in (",", "and") else one.marker
            elif element.value in ("before", "after") and _ends(elements, i):
                one.is_first = element.value == "before"
            else:
                fragments.append(Fragment(element.value))
        elif element.kind == "relative":
            is_relative = True
            one.is_seen |= not element.words.startswith(("that", "which", "the one")) and " " in element.words
            continue
        else:
            before = elements[i - 1] if i else None
            is_reported = before is not None and before.words in ("i", "we", "he")  # "I put it there"
            _take(one, element, is_relative, is_reported)
        is_relative = False
    found = [one for one in fragments if not one.is_empty]
    for before, one in pairwise(found):
        one.is_wish |= one.marker == "and" and before.is_wish and one.is_state
    return found


def _joins_pair(one: Fragment, joint: Element) -> bool:
    """Whether "and" stands in "between the plate and the ramekin"."""
    last = one.phrases[-1] if one.phrases else None
    return (
        joint.value == "and"
        and last is not None
        and last.preposition.relation == "between"
        and len(last.nouns) == 1
    )


def _ends(elements: Sequence[Element], i: int) -> bool:
    return i + 1 >= len(elements) or elements[i + 1].words in (",", ";")


def _take(one: Fragment, element: Element, is_relative: bool, is_reported: bool) -> None:
    """Add an element to a fragment."""
    if element.kind == "preposition" and element.preposition is not None:
        preposition = element.preposition
        is_reference = is_relative or preposition.is_source or preposition.is_relative
        one.phrases.append(Phrase(preposition, [], is_reference))
        one.is_wish |= preposition.is_goal and not one.is_state
    elif element.kind == "noun" and element.noun is not None:
        if element.noun.pronoun == "there":
            one.phrases.append(Phrase(Preposition("at", is_goal=True), [element.noun]))
            return
        last = one.phrases[-1] if one.phrases else None
        wanted = 2 if last and last.preposition.relation == "between" else 1
        if last and not last.preposition.place and len(last.nouns) < wanted:
            last.nouns.append(element.noun)
        elif not (one.nouns and element.noun.pronoun in ("it", "them") and not one.nouns[-1].pronoun):
            one.nouns.append(element.noun)
    elif element.kind in ("operation", "result"):
        if one.operation not in MADE:
            one.operation = element.value if element.value != v.HALF_A_VERB else one.operation
        is_told = element.kind == "operation" and not one.is_state and not is_reported
        one.is_wish |= is_told or (element.kind == "result" and bool(one.nouns) and not one.is_state)
        one.is_state |= is_reported
    elif element.kind == "wish":
        one.is_wish = True
    elif element.kind == "copula":
        one.is_state = True
