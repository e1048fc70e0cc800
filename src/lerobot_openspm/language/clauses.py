"""One clause: its verb, what it is done to, and which of its phrases say where that is or where it goes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.language.nouns import IMPLIED, Noun, read_noun, read_nouns
from lerobot_openspm.language.prepositions import Preposition, match_preposition
from lerobot_openspm.language.sentences import PREDICATES, Clause, Words
from lerobot_openspm.types import Reference

# Words of a predicate that do not say what is to become of the subject.
_AUXILIARIES = v.word_set(
    "should must needs need to has have had been ought be is are get gets being supposed meant could would"
)
_MODALS = v.word_set("should must needs need ought supposed meant to could would")
_GOES = v.word_set("goes go belongs belong")


@dataclass(frozen=True)
class Said:
    """What a clause says, before pronouns have their nouns.

    Attributes:
        operation: A key of :data:`vocabulary.VERBS`; "" for a clause that only names what is spoken of.
        targets: What it is done to.
        relation: Where that goes relative to the landmark, or "".
        landmark: Where it goes; None where that is not said.
        is_state: Whether it says how something is to be: "the bowl should be on the plate".
    """

    operation: str
    targets: tuple[Noun, ...]
    relation: str = ""
    landmark: Noun | None = None
    is_state: bool = False


@dataclass(frozen=True)
class _Phrase:
    """A preposition with the words after it."""

    preposition: Preposition
    words: Words


def read_clause(clause: Clause, before: Said | None) -> Said:
    """Read one clause; `before` is the clause before it, whose verb may hold here too.

    Raises:
        InstructionError: It has no verb, or nothing that it is done to.
    """
    words = clause.words
    if clause.is_same and before is not None:
        return replace(before, targets=tuple(read_nouns(words)))
    if not clause.is_seen:
        words = _verb_first(words)
        verb = v.match_verb(words, 0) or v.match_verb(words, 0, "gerund")
        if verb is None and clause.is_done:
            verb = v.match_verb(words, 0, "participle")
        if verb is not None:
            said = _read_verb(verb, words[verb.length :])
            return _checked(said, verb, before)
    said = _without_verb(clause, words, before)
    if said is not None:
        return said
    if clause.is_seen or _is_statement(words):
        return _topic(words)
    known = ", ".join(v.USUAL_VERBS)
    raise InstructionError(f"has no verb I know in {' '.join(words)!r} (such as {known})")


def _verb_first(words: Words) -> Words:
    """Put a phrase that stands before the verb behind it: "on the plate put the bowl"."""
    if match_preposition(words, 0) is None:
        return words
    for i in range(2, len(words)):
        if words[i] in _GOES:  # "onto the plate goes the bowl"
            return (*words[i + 1 :], words[i], *words[:i])
        if words[i] in ("is", "are") and words[i + 1 : i + 2] in (("a",), ("the",)):
            return (*words[i + 1 :], *words[:i])  # "on the stove is a bowl"
        at_verb = v.match_verb(words, i) is not None and words[i + 1 : i + 2] != ()
        if words[i] == "," or (at_verb and _has_determiner(words, i)):
            return (*words[i + (words[i] == ",") :], *words[:i])
    return words


def _has_determiner(words: Words, verb_at: int) -> bool:
    """Whether what follows a verb-like word is a noun phrase: "place the bowl", but not "place mat"."""
    verb = v.match_verb(words, verb_at)
    after = words[verb_at + (verb.length if verb else 1) :]
    return bool(after) and (after[0] in v.DETERMINERS or after[0] in v.PRONOUNS or after[0] in v.NUMBERS)


def _is_statement(words: Words) -> bool:
    """Whether words may say what the next clause is about: "the bowl is on the plate", or a thing alone."""
    return words[0] in v.DETERMINERS or len(words) == 1


def _topic(words: Words) -> Said:
    words = tuple(word for word in words if word not in ("is", "are"))
    head, phrases = _phrases(words)
    head, phrases = _with_part(head, phrases)
    noun = _which(read_noun(head), phrases[:1])
    return Said("", (noun,))


def _checked(said: Said, verb: v.Verb, before: Said | None) -> Said:
    if verb.word in v.OF_WHAT_IS_HELD and not said.targets[0].pronoun and not _is_beside(said, before):
        raise InstructionError(f"says to {verb.word} something as it is")
    if verb.word == "slide" and said.operation == "push" and said.relation in v.LIFTING_RELATIONS:
        return replace(said, operation="put")
    return said


def _is_beside(said: Said, before: Said | None) -> bool:
    """Whether something goes next to where another thing was just put: it does not stay as it is."""
    if before is None or before.operation != "put" or before.landmark is None or said.landmark is None:
        return False
    is_same = said.landmark.pronoun in ("it", "that") or said.landmark.name == before.landmark.name
    return is_same and said.relation in v.BESIDE


def _without_verb(clause: Clause, words: Words, before: Said | None) -> Said | None:
    """Read "the soup goes in the basket", "the bowl should be put on the plate", "the stove on"."""
    if words[0] in ("could", "would") and words[1:]:
        words = words[1:]
    at = next((i for i, word in enumerate(words) if i and word in PREDICATES), 0)
    if at:
        return _predicate(clause, words, at)
    for i in range(1, len(words)):  # "the pudding set down on the plate", "and the bowl placed inside"
        if (clause.is_wanted or before is not None) and _is_participle(words, i):
            return _state(words[:i], words[i:])
        if clause.is_wanted and words[i] in v.STANDS | _GOES:
            subject = words[: i - 1] if words[i - 1] == "to" else words[:i]  # "the bowl to stand on it"
            return _state(subject, words[i:])
    if clause.is_wanted and words[-1] in ("on", "off", "open", "shut", "closed"):
        return _state(words[:-1], words[-1:])
    return _verbless(clause, words, before)


def _predicate(clause: Clause, words: Words, at: int) -> Said | None:
    """Read a subject and, from a word on, what it is to be: "the bowl | should be put on the plate"."""
    end = at
    while end < len(words) and words[end] in _AUXILIARIES and words[end + 1 : end + 2] != ("the",):
        end += 1
    while at > 1 and words[at - 1] in _AUXILIARIES:
        at -= 1
    is_told = bool(set(words[at:end]) & _MODALS) or clause.is_done or clause.is_wanted
    subject, rest = words[:at], words[end:]
    if rest[:1] and rest[0] in _GOES:
        return _read("put", subject, rest[1:])
    return _state(subject, rest) if is_told and rest else None


def _verbless(clause: Clause, words: Words, before: Said | None) -> Said | None:
    """Read a thing and where it goes: "and the bottle on the rack", "ketchup into the basket"."""
    relations = [i for i in range(1, len(words)) if match_preposition(words, i)]
    if not relations:
        return None
    if before is not None and before.operation in ("put", "push"):
        return _of_other_place(_read(before.operation, words, ()), before)
    last = match_preposition(words, relations[-1])
    head = words[: relations[0]]
    is_thing = len(head) == 1 or (head[0] in v.DETERMINERS and not set(head[1:]) & v.DETERMINERS)
    is_directed = last is not None and last.is_goal and is_thing
    return _read("put", words, ()) if clause.is_wanted or is_directed else None


def _is_participle(words: Words, at: int) -> bool:
    """Whether a word says what is done to the noun before it: "placed", but not "left" in "the left mug"."""
    verb = v.match_verb(words, at, "participle")
    if verb is None or words[at - 1] in v.DETERMINERS:
        return False
    end = at + verb.length
    return end == len(words) or match_preposition(words, end) is not None


def _of_other_place(said: Said, before: Said) -> Said:
    """Complete "and the other mug on the right", after "the mug on the left plate"."""
    where = said.targets[-1].where
    if said.landmark is not None or before.landmark is None or where is None or where.landmarks:
        return said
    targets = (*said.targets[:-1], replace(said.targets[-1], where=None))
    return replace(
        said, targets=targets, relation=before.relation, landmark=replace(before.landmark, where=where)
    )


def _state(subject: Words, rest: Words) -> Said | None:
    """What is to be done so that a subject is as said: "open", "on", "placed on it", "on the plate"."""
    at = next((i for i, word in enumerate(rest[:-1]) if word not in v.STANDS | _GOES), len(rest) - 1)
    said = _made(subject, rest[at:])
    return None if said is None else replace(said, is_state=True)


def _made(subject: Words, rest: Words) -> Said | None:
    if verb := v.match_verb(rest, 0, "participle") or v.match_verb(rest, 0, "gerund"):
        return _read_verb(verb, (*subject, *rest[verb.length :]))
    if rest in (("on",), ("off",)):
        return _read(f"turn {rest[0]}", subject, ())
    if " ".join(rest) in v.RESULTS:
        return _read(v.RESULTS[" ".join(rest)], subject, ())
    return _read("put", subject, rest) if match_preposition(rest, 0) else None


def _read_verb(verb: v.Verb, rest: Words) -> Said:
    """Read what follows a verb; it may be split around its object: "turn the stove on"."""
    end = rest[-1] if len(rest) > 1 else ""
    if verb.length == 1 and verb.word in v.SWITCHES and end in ("on", "off"):
        return _read(f"turn {end}", rest[:-1], ())
    if verb.word in v.MOTIONS and verb.length == 1:
        if end in v.RESULTS:
            return _read(v.RESULTS[end], rest[:-1], ())
        thing = rest[:-2] if rest[-2:-1] == ("back",) else rest[:-1]
        if end in v.DRAWER_RESULTS and read_noun(thing).part:
            return _read(v.DRAWER_RESULTS[end], thing, ())
        if verb.word in ("pull", "draw") and _is_drawer_alone(rest):
            return _read("open", rest, ())
    if verb.operation == v.HALF_A_VERB:
        raise InstructionError(
            f"has no verb I know in {verb.word!r} alone; say what becomes of it: open, on, off"
        )
    return _read(verb.operation, rest, ())


def _is_drawer_alone(words: Words) -> bool:
    return not any(match_preposition(words, i) for i in range(len(words))) and bool(read_noun(words).part)


def _read(operation: str, words: Words, more: Words) -> Said:
    """Read what something is done to, and the phrases behind it."""
    head, phrases = _phrases((*words, *more))
    head, phrases = _with_part(_without_particles(head), phrases)
    targets = tuple(read_nouns(head)) or (IMPLIED,)
    if any(not noun.name and not noun.pronoun for noun in targets):
        raise InstructionError(f"names no object after {operation!r}")
    where, goal, landmark_where = _roles(operation, phrases)
    targets = (*targets[:-1], _which(targets[-1], where))
    if goal is None:
        return Said(operation, targets)
    relation = goal.preposition.relation
    relation = "on" if relation == "center" else relation  # "in the middle of the plate"
    if relation == "at" and read_noun(goal.words).part:
        relation = "in"  # "to the right compartment"
    noun = read_noun(goal.words)
    noun = replace(noun, pronoun="there") if not goal.words else noun
    if goal.preposition.is_inside and (part := v.PART_BY_PLACE.get(v.kind(noun.name))):
        noun, relation = replace(noun, part=f"{v.PLACE_OF_RELATION[relation]} {part}"), "in"
    landmark = _which(noun, landmark_where)
    return Said(operation, targets, relation, landmark)


def _without_particles(words: Words) -> Words:
    while words and (words[-1] in v.PARTICLES - {"right", "there", "back"} or words[-1] == ","):
        words = words[:-1]
    while words and words[0] in ("up", "down", "over", ","):
        words = words[1:]
    return words


def _phrases(words: Words) -> tuple[Words, list[_Phrase]]:
    """Split words into what stands before the first preposition, and the phrases."""
    head: list[str] = []
    phrases: list[_Phrase] = []
    current, i = head, 0
    while i < len(words):
        preposition = match_preposition(words, i)
        if preposition is None:
            current.append(words[i])
            i += 1
        else:
            current = []
            phrases.append(_Phrase(preposition, ()))
            i += preposition.length
            end = next((j for j in range(i, len(words)) if match_preposition(words, j)), len(words))
            phrases[-1] = _Phrase(preposition, _without_particles(words[i:end]))
            i = end
    return tuple(head), phrases


def _with_part(words: Words, phrases: list[_Phrase]) -> tuple[Words, list[_Phrase]]:
    """Join a part with the phrase that says where on its thing it is, here and in the phrases.

    "the compartment at the back of the caddy" becomes "the back compartment of the caddy".
    """
    chunks = [(None, words), *((phrase.preposition, phrase.words) for phrase in phrases)]
    joined: list[tuple[Preposition | None, Words]] = []
    for preposition, following in chunks:
        before = joined[-1][1] if joined else ()
        together = _part_and_place(before, preposition, following) if preposition and before else None
        if together is None:
            joined.append((preposition, following))
        else:
            joined[-1] = (joined[-1][0], together)
    return joined[0][1], [_Phrase(p, following) for p, following in joined[1:] if p is not None]


def _part_and_place(words: Words, preposition: Preposition, following: Words) -> Words | None:
    head = v.singular(words[-1])
    is_part = head in v.PART_OF or head in v.PART_SYNONYMS or head in v.NAMED_PARTS
    has_place = any(word in v.PLACES or word in v.HEIGHTS for word in words) or "of" in words or "'s" in words
    if not is_part or preposition.is_goal or preposition.is_source:
        return None
    if preposition.place and not has_place:
        return (*words[:-1], preposition.place, words[-1])
    if (
        preposition.relation == "in"
        and following
        and v.kind(v.singular(following[-1])) in ("cabinet", "caddy")
    ):
        return (*words, "of", *following)
    place = v.PLACE_OF_RELATION.get(preposition.relation, "")
    if preposition.relation == "on" and not following and not has_place:
        return (*words[:-1], "top", words[-1])  # "the drawer on top"
    if place and following and not has_place and head != "shelf":
        return (*words[:-1], place, words[-1], "of", *following)
    return None


def _roles(operation: str, phrases: list[_Phrase]) -> tuple[list[_Phrase], _Phrase | None, list[_Phrase]]:
    """Which phrases say which target is meant, which one where it goes, and which landmark is meant."""
    at = _goal_at(operation, phrases)
    if at is None:
        return phrases, None, []
    sources = [phrase for phrase in phrases[at + 1 :] if phrase.preposition.is_source]
    after = [phrase for phrase in phrases[at + 1 :] if not phrase.preposition.is_source]
    return [*phrases[:at], *sources], phrases[at], after


def _goal_at(operation: str, phrases: list[_Phrase]) -> int | None:
    """Which phrase says where the target goes."""
    if operation not in ("put", "push", "pick"):
        return None
    free = [
        i
        for i, phrase in enumerate(phrases)
        if not (phrase.preposition.place or phrase.preposition.is_source or phrase.preposition.is_relative)
    ]
    if goals := [i for i in free if phrases[i].preposition.is_goal]:
        return goals[0]
    if operation == "pick" or not free:
        return None
    # "on the plate next to the stove": the stove tells which plate.
    supporting = [i for i in free if phrases[i].preposition.relation in ("on", "in", "under")]
    return supporting[-1] if supporting else free[-1]


def _which(noun: Noun, phrases: list[_Phrase]) -> Noun:
    """Give a noun the phrase that tells which of several it is."""
    if not phrases:
        return noun
    preposition, words = phrases[-1].preposition, phrases[-1].words
    if preposition.place:
        return replace(noun, where=Reference(preposition.place))
    nouns = [one for one in read_nouns(words) if one.name]
    if not nouns:
        return noun
    if nouns[0].part in v.PLACES.values():  # "from the table's centre"
        return replace(noun, where=Reference("center", (nouns[0].name,)))
    relation = preposition.relation
    if relation in ("", "at"):
        relation = "in" if nouns[0].part or nouns[0].name.split()[-1] in v.HOLLOW else "on"
    relation = {"behind": "back"}.get(relation, relation.removesuffix(" of"))
    return replace(noun, where=Reference(relation, tuple(one.name for one in nouns)))
