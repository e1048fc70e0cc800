"""Prepositions: relation, place and direction. Noun phrases: which thing, which part of it, how many."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.lexicon import Lexicon, Words
from lerobot_openspm.types import Reference

# Marks that the rewriting rules leave: something is asked for without a verb; it is what is spoken of; what
# follows belongs to the noun before it; the clause before is repeated.
WANTED, SEEN, WHICH, SAME = "@wanted", "@seen", "@which", "@same"
# A part is called by the place where it is, and "left of" is said of what is on the left of something.
PLACE_OF_RELATION = {
    "front of": "front", "behind": "back", "left of": "left", "right of": "right", "center": "middle",
    "on": "top", "under": "bottom",
}  # fmt: skip
_RELATION_OF_PLACE = {
    "front": "front of", "back": "behind", "left": "left of", "right": "right of", "middle": "center",
}  # fmt: skip


@dataclass(frozen=True)
class Preposition:
    """A preposition where it stands.

    Attributes:
        relation: What it means, one of :data:`lexicon.RELATIONS` or "center"; "" for a bare "from".
        place: Where in the scene, of a phrase that needs no noun ("on the left"): one of
            :data:`lexicon.PLACES`; else "".
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


def match_preposition(lex: Lexicon, words: Words, at: int) -> Preposition | None:
    """The longest preposition that begins at a word, with the marks and particles before it."""
    start = at
    while start < len(words) and (words[start] == WHICH or words[start] in lex.particles):
        direct = _match(lex, words, start) if start == at else None
        if direct:  # "right of", "out of"; but "on top of" in "up on top of"
            after = _match(lex, words, start + 1)
            if after is None or after.length + 1 <= direct.length:
                return direct
        start += 1
    found = _match(lex, words, start)
    if found is None:
        return None
    return replace(found, is_relative=WHICH in words[at:start], length=found.length + start - at)


def _match(lex: Lexicon, words: Words, at: int) -> Preposition | None:
    if source := lex.longest(words, at, lex.sources):  # "from", "from on top of", "from the left"
        length = len(source.split())
        inner = match_preposition(lex, words, at + length) or _place(lex, words, at + length, 0)
        if inner is None:
            return Preposition(lex.sources[source], is_source=True, length=length)
        return Preposition(inner.relation, inner.place, is_source=True, length=length + inner.length)
    first = words[at] if at < len(words) else ""
    if first in ("on", "at", "in", "into", "to", "toward", "towards", "onto") and (
        found := _place(lex, words, at, 1, first in ("to", "onto", "into"))
    ):
        return replace(found, is_inside=True) if first in ("in", "into") else found
    if phrase := lex.longest(words, at, lex.relations):
        if words[at:] == ("on", "top"):
            return Preposition("on", length=2)  # of what was spoken of
        inner = _match(lex, words, at + 1) if phrase == "to" else None
        if inner and inner.relation and not inner.is_source:  # "to underneath"
            return replace(inner, is_goal=True, length=inner.length + 1)
        return Preposition(lex.relations[phrase], is_goal=phrase in lex.goals, length=len(phrase.split()))
    return None


def _place(lex: Lexicon, words: Words, at: int, length: int, goal: bool = False) -> Preposition | None:
    """Match "on the left", "at the front of", "in the middle of", "in front"."""
    end = at + length
    end += end < len(words) and words[end] in ("the", "its", "far", "very")
    end += end < len(words) and words[end] in ("far", "very")
    place = lex.places.get(words[end]) or lex.heights.get(words[end]) if end < len(words) else ""
    if not place or words[at:end] == ("on",):
        return None
    end += 1
    end += end < len(words) and words[end] == "hand"
    end += end < len(words) and words[end] in ("side", "edge", "end", "part")
    after = words[end] if end < len(words) else ""
    if after == "of" and place in _RELATION_OF_PLACE:
        return Preposition(_RELATION_OF_PLACE[place], is_goal=goal, length=end + 1 - at)
    if after and after != "," and match_preposition(lex, words, end) is None:
        return None  # "on the left plate"
    return Preposition("", place, length=end - at)


@dataclass(frozen=True)
class Phrase:
    """A preposition with the words after it."""

    preposition: Preposition
    words: Words


def split_phrases(lex: Lexicon, words: Words) -> list[Phrase]:
    """Split words at their prepositions; the first phrase has none.

    A part is joined with the phrase that says where on its thing it is: "the compartment at the back of the
    caddy" becomes "the back compartment of the caddy".
    """
    found: list[Phrase] = []
    preposition, start = Preposition(""), 0
    for i in range(len(words) + 1):
        following = match_preposition(lex, words, i) if start <= i < len(words) else None
        if i < start or (following is None and i < len(words)):
            continue
        piece = _without_particles(lex, words[start:i])
        before = found[-1].words if found else ()
        if together := _part_and_place(lex, before, preposition, piece):
            found[-1] = Phrase(found[-1].preposition, together)
        else:
            found.append(Phrase(preposition, piece))
        if following is not None:
            preposition, start = following, i + following.length
    return found


def _without_particles(lex: Lexicon, words: Words) -> Words:
    while words and (words[-1] in lex.particles - {"right", "back"} or words[-1] == ","):
        words = words[:-1]
    while words and words[0] in ("up", "down", "over", ","):
        words = words[1:]
    return words


def _part_and_place(lex: Lexicon, words: Words, preposition: Preposition, following: Words) -> Words:
    """Join a part with where it is; nothing where a phrase says something else."""
    head = lex.singular(words[-1]) if words else ""
    is_part = head in lex.parts or head in lex.part_synonyms or head in lex.named_parts
    has_place = any(map(lex.is_position, words)) or "of" in words or "'s" in words
    place = preposition.place or PLACE_OF_RELATION.get(preposition.relation, "")
    if not is_part or preposition.is_goal or preposition.is_source:
        return ()
    is_owner = bool(following) and lex.kind(lex.singular(following[-1])) in ("cabinet", "caddy")
    if is_owner and (preposition.relation == "in" or (preposition.relation == "on" and has_place)):
        return (*words, "of", *following)
    if has_place or not place:
        return ()
    if preposition.place or (preposition.relation == "on" and not following):  # "the drawer on top"
        return (*words[:-1], place, words[-1])
    return (*words[:-1], place, words[-1], "of", *following) if following and head != "shelf" else ()


@dataclass(frozen=True)
class Noun:
    """What a noun phrase says.

    Attributes:
        name: The thing, in the words that objects are known by; "" where a pronoun stands for it.
        part: The part of it that is meant, or "".
        where: Which of several; None where it is not said.
        count: How many.
        pronoun: "it" or "them" where the phrase is one; "one" for "the white one", whose name holds what
            is said of it; "its" for a part of what was spoken of; else "".
    """

    name: str = ""
    part: str = ""
    where: Reference | None = None
    count: int = 1
    pronoun: str = ""


IMPLIED = Noun(pronoun="it")


def read_nouns(lex: Lexicon, words: Words) -> list[Noun]:
    """Read one noun phrase or several, joined by "and" or commas."""
    if "and" in words:
        words = tuple(word for word in words if word != "both")
    groups: list[list[str]] = [[]]
    for i, word in enumerate(words):
        if word in ("and", ",") and not (i and {words[i - 1], *words[i + 1 : i + 2]} <= lex.colours):
            groups.append([])
        else:
            groups[-1].append(word)
    told = [tuple(group) for group in groups if group]
    nouns = [read_noun(lex, group) for group in told]
    if len(nouns) > 1 and not any(_has_number(lex, group) for group in told) and "pair" not in words:
        nouns = [replace(noun, count=1) for noun in nouns]  # "the cans of soup and sauce"
    return nouns


def _has_number(lex: Lexicon, words: Words) -> bool:
    """Whether a noun phrase says how many there are."""
    return any(lex.number(word) and not _is_in_name(lex, words[i:]) for i, word in enumerate(words))


def read_noun(lex: Lexicon, words: Words) -> Noun:
    """Read one noun phrase; an empty one is a thing that goes without saying.

    Raises:
        InstructionError: A second noun phrase begins within the words.
    """
    words = tuple(word for word in words if word not in lex.fillers and word != ",")
    if len(words) > 1 and words[-1] == "a" and words[-2] not in lex.determiners:  # "block a"
        noun = read_noun(lex, words[:-1])
        return replace(noun, name=f"{noun.name} a")
    for before, word in pairwise(words):
        if word in lex.determiners and before not in ("of", "'s", "both", "all", "each", ","):
            raise InstructionError(f"has words I cannot read: {' '.join(words)!r}")
    single = words[1:] if words[:1] == ("the",) else words
    if len(single) > 2 and single[0] in ("one", "1") and single[1] == "of":
        return replace(read_noun(lex, single[2:]), count=1)
    words, count = _split_count(lex, words)
    bare = " ".join(word for word in words if word not in ("the", "whole"))
    pronoun = lex.pronouns.get(" ".join(words)) or lex.pronouns.get(bare)
    if pronoun or not words:
        return Noun(pronoun="them" if count > 1 else pronoun or "it")
    if words[0] == "its" and len(words) > 1:
        noun = _read_whole(lex, words[1:], "its")
        return replace(noun, pronoun=noun.pronoun or "its")
    words = tuple(word for word in words if word not in lex.determiners)
    if "'s" in words:  # "the cabinet's top drawer" is "the top drawer of the cabinet"
        at = words.index("'s")
        words = (*words[at + 1 :], "of", *words[:at])
    at = words.index("of") if "of" in words else 0
    noun = _read_of(lex, words[:at], words[at + 1 :]) if at else _read_whole(lex, words)
    return replace(noun, count=max(count, noun.count))


def _split_count(lex: Lexicon, words: Words) -> tuple[Words, int]:
    """Take numbers off the front: "the two bowls", "both of the bowls", "a pair of bowls"."""
    count = 1
    while words and not _is_in_name(lex, words):
        one, two = words[0], " ".join(words[:2])
        following = {*words[1:2], " ".join(words[1:3])}
        counts_next = not following.isdisjoint(("one", "1")) or any(map(lex.number, following))
        if number := lex.number(two) or lex.number(one):
            count, words = number, words[2 if lex.number(two) else 1 :]
            words = words[1:] if words[:1] == ("of",) else words
        elif len(words) > 1 and one in ("one", "1") and not lex.number(words[1]):
            words = words[1:]
        elif len(words) > 1 and one in ("all", "each"):
            count, words = 2, words[1:]
        elif len(words) > 1 and one in ("the", "a", "of") and (counts_next or count > 1):
            words = words[1:]
        else:
            break
    return words, count


def _is_in_name(lex: Lexicon, words: Words) -> bool:
    """Whether a number in digits belongs to a name: "10 mm sockets", "a 24 can pack", "the 8 ball"."""
    if len(words) < 2 or not words[0].isdecimal() or words[1] == "of":
        return False
    holds = len(words) > 2 and words[1] in lex.containers and words[2] != "of"
    counts_one = int(words[0]) == 1 or words[-1] in lex.uncountable
    is_one = not counts_one and tuple(map(lex.singular, words)) == words
    return lex.singular(words[1]) in lex.units or holds or is_one


def _read_of(lex: Lexicon, before: Words, whole: Words) -> Noun:
    """Read "the top drawer of the cabinet", "a can of soup", "the top layer of the drawer"."""
    head = lex.singular(before[-1])
    if head == "one":  # "the middle one of the bowls"
        return replace(_read_whole(lex, (*before[:-1], *whole)), count=1)
    if head in lex.containers and before[0] not in lex.heights:
        places = tuple(word for word in before[:-1] if word in lex.places)
        noun = _read_whole(lex, (*places, *whole, head))
        # A can of soup is soup, but a bottle of wine is not wine.
        is_name = noun.name in (*lex.aliases.values(), "cream cheese box", "cookie box")
        name = noun.name if is_name else noun.name.rpartition(" ")[0]
        return replace(noun, name=name, count=2 if before[-1] != head else 1)
    thing = _read_whole(lex, whole)
    # "the layer of the drawer": the drawer is the whole that has drawers.
    name = thing.name if not thing.part or thing.part in lex.parts else f"{thing.part} {thing.name}"
    return replace(thing, name=name, part=_part(lex, before), count=1)


def _read_whole(lex: Lexicon, words: Words, owner: str = "") -> Noun:
    """Read "the left plate", "top drawer", "cabinet shelf", "white mugs"."""
    words = tuple(word for word in words if word not in lex.determiners and word != "hand")
    if not words:
        return IMPLIED
    head, rest = lex.singular(words[-1]), words[:-1]
    count = 2 if head != words[-1] else 1
    if head in lex.places and rest:  # "table center", "the bowl furthest back"
        name, place = " ".join(rest), lex.places[head]
        return Noun(name, place) if rest[-1] in lex.surfaces else Noun(name, "", Reference(place))
    positions = tuple(word for word in rest if lex.is_position(word))
    thing = tuple(word for word in rest if word not in positions)
    is_synonym = head in lex.part_synonyms and positions and (owner or head not in lex.named_with_thing)
    if head != "one" and (head in lex.parts or is_synonym or (head in lex.named_parts and (owner or thing))):
        part = _part(lex, (*positions, head))
        whole = lex.parts.get(part.split()[-1], "")
        told = thing and (head in lex.named_parts or not set(thing) <= lex.colours)
        return Noun(" ".join(thing) if told else whole, part, None, count)
    places = [lex.places[word] for word in rest if word in lex.places]
    name = _colours_in_order(lex, tuple(word for word in rest if word not in lex.places))
    where = Reference(places[0]) if places else None
    if head == "one":
        return Noun(name, "", where, 1, "one")
    return Noun(f"{name} {head}".strip(), "", where, count)


def _part(lex: Lexicon, words: Words) -> str:
    """The name of a part: "lowest drawer" is the bottom drawer, "rear section" the back compartment."""
    *found, head = (lex.position(word) for word in words if word not in lex.determiners)
    head = lex.singular(head)
    found.append(lex.part_synonyms.get(head, head))
    return " ".join(word for word in found if word not in ("hand", "side"))


def _colours_in_order(lex: Lexicon, words: Words) -> str:
    """One wording for "white and yellow", "yellow white" and "yellow and white": white and black last."""
    colours = [word for word in words if word in lex.colours]
    if len(colours) < 2:
        return " ".join(words)
    rest = [word for word in words if word not in lex.colours and word not in ("and", ",")]
    ordered = sorted(colours, key=lambda colour: (colour in ("white", "black"), colour))
    return " ".join([" and ".join(ordered), *rest])
