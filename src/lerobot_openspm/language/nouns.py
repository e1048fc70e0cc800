"""Noun phrases: which thing is meant, which part of it, which of several, and how many."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.types import Reference

Words = tuple[str, ...]


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


def read_nouns(words: Words) -> list[Noun]:
    """Read one noun phrase or several, joined by "and" or commas."""
    groups = _coordinated(_without(words, ("both",)) if "and" in words else words)
    nouns = [read_noun(group) for group in groups]
    if len(nouns) > 1 and not any(map(_has_number, groups)) and not {"pair", "couple"} & set(words):
        nouns = [replace(noun, count=1) for noun in nouns]  # "the cans of soup and sauce"
    return nouns


def _has_number(words: Words) -> bool:
    """Whether a noun phrase says how many there are."""
    return any(word in v.NUMBERS and not _is_in_name(words[i:]) for i, word in enumerate(words))


def _coordinated(words: Words) -> list[Words]:
    groups: list[Words] = []
    current: list[str] = []
    for i, word in enumerate(words):
        colours = i > 0 and i + 1 < len(words) and {words[i - 1], words[i + 1]} <= v.COLOURS
        if word in ("and", ",") and not colours:
            groups.append(tuple(current))
            current = []
        else:
            current.append(word)
    return [group for group in (*groups, tuple(current)) if group]


def _without(words: Words, unwanted: Words) -> Words:
    return tuple(word for word in words if word not in unwanted)


def read_noun(words: Words) -> Noun:
    """Read one noun phrase; an empty one is a thing that goes without saying.

    Raises:
        InstructionError: A second noun phrase begins within the words.
    """
    words = tuple(word for word in words if word not in v.FILLERS and word != ",")
    if len(words) > 1 and words[-1] == "a" and words[-2] not in v.DETERMINERS:  # "block a"
        noun = read_noun(words[:-1])
        return replace(noun, name=f"{noun.name} a")
    for before, word in pairwise(words):
        if word in v.DETERMINERS and before not in ("of", "'s", "both", "all", "each", ","):
            raise InstructionError(f"has words I cannot read: {' '.join(words)!r}")
    single = words[1:] if words[:1] == ("the",) else words
    if len(single) > 2 and single[0] in ("one", "1") and single[1] == "of":
        return replace(read_noun(single[2:]), count=1)
    words, count = _split_count(words)
    bare = tuple(word for word in words if word not in ("the", "whole"))
    words = bare if " ".join(bare) in v.PRONOUNS else words
    if " ".join(words) in v.PRONOUNS or not words:
        pronoun = v.PRONOUNS.get(" ".join(words), "them" if count > 1 else "it")
        return Noun(pronoun="them" if count > 1 else pronoun, count=1)
    if words[0] == "its" and len(words) > 1:
        noun = _read_whole(words[1:], "its")
        return replace(noun, pronoun=noun.pronoun or "its")
    words = tuple(word for word in words if word not in v.DETERMINERS)
    if "'s" in words:  # "the cabinet's top drawer" is "the top drawer of the cabinet"
        at = words.index("'s")
        words = (*words[at + 1 :], "of", *words[:at])
    if "of" in words and (at := words.index("of")) > 0:
        noun = _read_of(words[:at], words[at + 1 :])
    else:
        noun = _read_whole(words)
    return replace(noun, count=max(count, noun.count))


def _split_count(words: Words) -> tuple[Words, int]:
    """Take numbers off the front: "the two bowls", "both of the bowls", "a pair of bowls"."""
    rest, count = list(words), 1
    while rest:
        one, two = rest[0], " ".join(rest[:2])
        if (
            one in ("one", "1")
            and len(rest) > 1
            and rest[1] not in v.NUMBERS
            and not _is_in_name(tuple(rest))
        ):
            rest = rest[1:]
            continue
        if _is_in_name(tuple(rest)):
            break
        if two in v.NUMBERS or one in v.NUMBERS:
            used = 2 if two in v.NUMBERS else 1
            count, rest = v.NUMBERS[two if used == 2 else one], rest[used:]
            rest = rest[1:] if rest[:1] == ["of"] else rest
            if not rest:
                return (), count
        elif one in ("the", "a", "of", "all", "each") and len(rest) > 1:
            following = " ".join(rest[1:3]), rest[1]
            if (
                one != "all"
                and not set(following) & {*v.NUMBERS, "one", "1"}
                and count == 1
                and one != "each"
            ):
                break
            count, rest = max(count, 2 if one in ("all", "each") else 1), rest[1:]
        else:
            break
    return tuple(rest), count


def _is_in_name(words: Words) -> bool:
    """Whether a number in digits belongs to a name: "10 mm sockets", "a 24 can pack", "the 8 ball"."""
    if len(words) < 2 or not words[0].isdecimal() or words[1] == "of":
        return False
    holds = len(words) > 2 and words[1] in v.CONTAINERS and words[2] != "of"
    counts_one = int(words[0]) == 1 or words[-1] in v.UNCOUNTABLE
    is_one = not counts_one and all(v.singular(word) == word for word in words)
    return v.singular(words[1]) in v.UNITS or holds or is_one


def _read_of(before: Words, whole: Words) -> Noun:
    """Read "the top drawer of the cabinet", "a can of soup", "the top layer of the drawer"."""
    head = v.singular(before[-1])
    if head in v.CONTAINERS and (len(before) == 1 or before[0] not in v.PLACES | v.HEIGHTS):
        noun = _read_whole((*whole, head))
        return replace(noun, name=_contents(noun.name), count=2 if before[-1] != head else 1)
    thing = _read_whole(whole)
    # "the layer of the drawer": the drawer is the whole that has drawers.
    name = thing.name if not thing.part or thing.part in v.PART_OF else f"{thing.part} {thing.name}"
    return replace(thing, name=name, part=_part(before), count=1)


def _contents(name: str) -> str:
    """The usual name of what comes in a container: a can of soup is soup, a bottle of wine not wine."""
    words = name.split()
    return (
        name
        if " ".join(words) in (*v.ALIASES.values(), "cream cheese box", "cookie box")
        else " ".join(words[:-1])
    )


def _read_whole(words: Words, owner: str = "") -> Noun:
    """Read "the left plate", "top drawer", "cabinet shelf", "white mugs"."""
    words = tuple(word for word in words if word not in v.DETERMINERS and word != "hand")
    if not words:
        return IMPLIED
    head = v.singular(words[-1])
    count = 2 if head != words[-1] else 1
    rest = words[:-1]
    if head in v.PLACES and rest:  # "table center", "the bowl furthest back"
        place = v.PLACES[head]
        return Noun(_name(rest), place) if rest[-1] in v.SURFACES else Noun(_name(rest), "", Reference(place))
    if head == "one":
        places, rest = _places(rest)
        return Noun(_colours_in_order(rest), "", places, 1, "one")
    is_part = head in v.PART_SYNONYMS and _sayings(rest) and (owner or head not in v.NAMED_WITH_THING)
    if _is_part(head) or is_part or (owner and head in v.NAMED_PARTS):
        return _read_part(rest, head, count)
    if head in v.NAMED_PARTS and (thing := tuple(word for word in rest if not _is_position(word))):
        return replace(_read_part(rest, head, count), name=_name(thing))
    places, rest = _places(rest)
    return Noun(_name((*_singular_colours(rest), head)), "", places, count)


def _is_part(word: str) -> bool:
    return word in v.PART_OF


def _is_position(word: str) -> bool:
    return word in v.PLACES or word in v.HEIGHTS


def _sayings(words: Words) -> bool:
    return any(_is_position(word) for word in words)


def _read_part(rest: Words, head: str, count: int) -> Noun:
    """Read the words before a part: where it is on its thing, and what its thing is."""
    thing = tuple(word for word in rest if not _is_position(word))
    part = _part((*(word for word in rest if _is_position(word)), head))
    whole = v.PART_OF.get(part.split()[-1], "")
    if thing and not set(thing) <= v.COLOURS:
        whole = _name(thing)
    return Noun(whole, part, None, count)


def _part(words: Words) -> str:
    """The name of a part: "lowest drawer" is the bottom drawer, "rear section" the back compartment."""
    found = [v.PLACES.get(word) or v.HEIGHTS.get(word) or word for word in words if word not in v.DETERMINERS]
    found[-1] = v.singular(found[-1])
    if found[-1] in v.PART_SYNONYMS:
        found[-1] = v.PART_SYNONYMS[found[-1]]
    return " ".join(word for word in found if word not in ("hand", "side"))


def _places(words: Words) -> tuple[Reference | None, Words]:
    """Split off where the thing is among others of its name."""
    places = [v.PLACES[word] for word in words if word in v.PLACES]
    return (Reference(places[0]) if places else None), tuple(word for word in words if word not in v.PLACES)


def _singular_colours(words: Words) -> Words:
    return tuple(_colours_in_order(words).split())


def _colours_in_order(words: Words) -> str:
    """One wording for "white and yellow", "yellow white" and "yellow and white": white and black last."""
    colours = [word for word in words if word in v.COLOURS]
    if len(colours) < 2:
        return " ".join(words)
    rest = [word for word in words if word not in v.COLOURS and word not in ("and", ",")]
    ordered = sorted(colours, key=lambda colour: (colour in ("white", "black"), colour))
    return " ".join([" and ".join(ordered), *rest])


def _name(words: Words) -> str:
    return " ".join(words)
