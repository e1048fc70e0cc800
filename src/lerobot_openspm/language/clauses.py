"""One clause: its verb, what it is done to, and which of its phrases say where that is or where it goes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.lexicon import HALF_A_VERB, Form, Lexicon, Verb, Words
from lerobot_openspm.language.phrases import (
    IMPLIED,
    PLACE_OF_RELATION,
    WHICH,
    Noun,
    Preposition,
    match_preposition,
    read_noun,
    read_nouns,
)
from lerobot_openspm.language.sentences import Clause, has_object
from lerobot_openspm.types import Reference

# What errors name: one verb for each operation.
_USUAL_VERBS = "pick up, put, open, close, push, turn on, turn off"
# "slide the pan under the shelf": where the way does not lead along the table, sliding is putting.
_LIFTING_RELATIONS = ("on", "in", "under")


@dataclass(frozen=True)
class Said:
    """What a clause says, before pronouns have their nouns.

    Attributes:
        operation: One of :data:`lexicon.OPERATIONS`; "" for a clause that only names what is spoken of.
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


def read_clause(lex: Lexicon, clause: Clause, before: Said | None) -> Said:
    """Read one clause; `before` is the clause before it, whose verb may hold here too.

    Raises:
        InstructionError: It has no verb, or nothing that it is done to.
    """
    words = clause.words
    if clause.is_same and before is not None:
        return replace(before, targets=tuple(read_nouns(lex, words)))
    if not clause.is_seen:
        words = _verb_first(lex, words)
        forms: tuple[Form, ...] = ("base", "gerund", "participle") if clause.is_done else ("base", "gerund")
        if verb := lex.match_verb(words, 0, *forms):
            said = _read_verb(lex, verb, words[verb.length :])
            lifts = verb.word == "slide" and said.relation in _LIFTING_RELATIONS
            return replace(said, operation="put") if lifts else said
    said = _without_verb(lex, clause, words, before)
    if said is not None:
        return said
    if clause.is_seen or words[0] in lex.determiners or len(words) == 1 or WHICH in words:
        return _topic(lex, words)  # "the bowl is on the plate", or a thing alone
    raise InstructionError(f"has no verb I know in {' '.join(words)!r} (such as {_USUAL_VERBS})")


def _verb_first(lex: Lexicon, words: Words) -> Words:
    """Put a phrase that stands before the verb behind it: "on the plate put the bowl"."""
    if match_preposition(lex, words, 0) is None:
        return words
    for i in range(2, len(words)):
        if words[i] in lex.goes:  # "onto the plate goes the bowl"
            return (*words[i + 1 :], words[i], *words[:i])
        if words[i] == "," or has_object(lex, words, i):
            return (*words[i + (words[i] == ",") :], *words[:i])
    return words


def _topic(lex: Lexicon, words: Words) -> Said:
    at = next((i for i, word in enumerate(words) if word in ("is", "are")), len(words))
    has_phrase = any(match_preposition(lex, words, i) for i in range(at, len(words) - 1))
    words = (*words[:at], *words[at + 1 :]) if has_phrase else words[:at]  # "the drawer is open"
    head, *phrases = _phrases(lex, words)
    return Said("", (_which(lex, read_noun(lex, head.words), phrases[:1]),))


def _without_verb(lex: Lexicon, clause: Clause, words: Words, before: Said | None) -> Said | None:
    """Read "the soup goes in the basket", "the bowl should be put on the plate", "the stove on"."""
    if words[0] in ("could", "would") and words[1:]:
        words = words[1:]
    at = next((i for i, word in enumerate(words) if i and word in lex.predicates), 0)
    if at:
        return _predicate(lex, clause, words, at)
    for i in range(1, len(words)):  # "the pudding set down on the plate", "and the bowl placed inside"
        stands = words[i] in lex.stands | lex.goes or _is_participle(lex, words, i)
        if clause.is_wanted and stands:
            return _state(lex, words[:i], words[i:])
    if (clause.is_wanted or clause.is_done) and words[-1] in ("on", "off", "open", "shut", "closed"):
        return _state(lex, words[:-1], words[-1:])
    return _verbless(lex, clause, words, before)


def _predicate(lex: Lexicon, clause: Clause, words: Words, at: int) -> Said | None:
    """Read a subject and, from a word on, what it is to be: "the bowl | should be put on the plate"."""
    end = at
    while end < len(words) and words[end] in lex.auxiliaries and words[end + 1 : end + 2] != ("the",):
        end += 1
    while at > 1 and words[at - 1] in lex.auxiliaries:
        at -= 1
    is_told = bool(set(words[at:end]) & lex.modals) or clause.is_done or clause.is_wanted
    subject, rest = words[:at], words[end:]
    if rest[:1] and rest[0] in lex.goes:
        return _read(lex, "put", subject, rest[1:])
    return _state(lex, subject, rest) if is_told and rest else None


def _verbless(lex: Lexicon, clause: Clause, words: Words, before: Said | None) -> Said | None:
    """Read a thing and where it goes: "and the bottle on the rack", "ketchup into the basket"."""
    relations = [i for i in range(1, len(words)) if match_preposition(lex, words, i)]
    if not relations:
        return None
    if before is not None and before.operation in ("put", "push"):
        return _of_other_place(lex, _read(lex, before.operation, words, ()), before)
    last = match_preposition(lex, words, relations[-1])
    is_thing = relations[0] == 1 or words[0] in lex.determiners
    if not clause.is_wanted and not (last and last.is_goal and is_thing):
        return None
    said = _read(lex, "put", words, ())
    if said.landmark is None and WHICH in words:  # "I'd like the bottle standing on the cabinet"
        return _read(lex, "put", tuple(word for word in words if word != WHICH), ())
    return said


def _is_participle(lex: Lexicon, words: Words, at: int) -> bool:
    """Whether a word says what is done to the noun before it: "placed", but not "left" in "the left mug"."""
    verb = lex.match_verb(words, at, "participle")
    end = at + verb.length if verb else at
    return end > at and (end == len(words) or match_preposition(lex, words, end) is not None)


def _of_other_place(lex: Lexicon, said: Said, before: Said) -> Said:
    """Complete "and the other mug on the right", after "the mug on the left plate"."""
    where = said.targets[-1].where
    if said.landmark is not None or before.landmark is None or where is None or where.landmarks:
        return said
    targets = (*said.targets[:-1], replace(said.targets[-1], where=None))
    return replace(
        said, targets=targets, relation=before.relation, landmark=replace(before.landmark, where=where)
    )


def _state(lex: Lexicon, subject: Words, rest: Words) -> Said | None:
    """What is to be done so that a subject is as said: "open", "on", "placed on it", "on the plate"."""
    at = next((i for i, word in enumerate(rest[:-1]) if word not in lex.stands | lex.goes), len(rest) - 1)
    said = _made(lex, subject, rest[at:])
    return None if said is None else replace(said, is_state=True)


def _made(lex: Lexicon, subject: Words, rest: Words) -> Said | None:
    if verb := lex.match_verb(rest, 0, "participle", "gerund"):
        return _read_verb(lex, verb, (*subject, *rest[verb.length :]))
    if rest in (("on",), ("off",)):
        return _read(lex, f"turn {rest[0]}", subject, ())
    if " ".join(rest) in lex.results:
        return _read(lex, lex.results[" ".join(rest)], subject, ())
    return _read(lex, "put", subject, rest) if match_preposition(lex, rest, 0) else None


def _read_verb(lex: Lexicon, verb: Verb, rest: Words) -> Said:
    """Read what follows a verb; it may be split around its object: "turn the stove on"."""
    end = rest[-1] if len(rest) > 1 else ""
    if verb.length == 1 and verb.word in lex.switches and end in ("on", "off"):
        return _read(lex, f"turn {end}", rest[:-1], ())
    if verb.word in lex.motions and verb.length == 1:
        if end in lex.results:
            return _read(lex, lex.results[end], rest[:-1], ())
        thing = rest[:-2] if rest[-2:-1] == ("back",) else rest[:-1]
        if end in lex.drawer_results and read_noun(lex, thing).part:
            return _read(lex, lex.drawer_results[end], thing, ())
        drawer = _read(lex, "open", rest, ()).targets[-1] if verb.word in ("pull", "draw") else IMPLIED
        if drawer.part and drawer.where is None:
            return Said("open", (drawer,))
    if verb.operation == HALF_A_VERB:
        raise InstructionError(
            f"has no verb I know in {verb.word!r} alone; say what becomes of it: open, on, off"
        )
    return _read(lex, verb.operation, rest, ())


def _read(lex: Lexicon, operation: str, words: Words, more: Words) -> Said:
    """Read what something is done to, and the phrases behind it."""
    head, *phrases = _phrases(lex, (*words, *more))
    targets = tuple(read_nouns(lex, head.words)) or (IMPLIED,)
    if any(not noun.name and not noun.pronoun for noun in targets):
        raise InstructionError(f"names no object after {operation!r}")
    at = _goal_at(operation, phrases)
    sources = [phrase for phrase in phrases[at + 1 :] if phrase.preposition.is_source]
    targets = (*targets[:-1], _which(lex, targets[-1], [*phrases[:at], *sources]))
    if at == len(phrases):
        is_taken = operation == "put" and any(phrase.preposition.is_source for phrase in phrases)
        return Said("pick" if is_taken else operation, targets)  # "bring the bowl down from the cabinet"
    goal, relation = phrases[at], phrases[at].preposition.relation
    noun = read_noun(lex, goal.words) if goal.words else Noun(pronoun="there")
    if relation == "center":
        relation = "on"  # "in the middle of the plate"
    elif relation == "at" and noun.part:
        relation = "in"  # "to the right compartment"
    if goal.preposition.is_inside and (part := lex.parts_by_place.get(lex.kind(noun.name))):
        noun, relation = replace(noun, part=f"{PLACE_OF_RELATION[relation]} {part}"), "in"
    after = [phrase for phrase in phrases[at + 1 :] if not phrase.preposition.is_source]
    return Said(operation, targets, relation, _which(lex, noun, after))


def _phrases(lex: Lexicon, words: Words) -> list[_Phrase]:
    """Split words at their prepositions; the first phrase has none.

    A part is joined with the phrase that says where on its thing it is: "the compartment at the back of the
    caddy" becomes "the back compartment of the caddy".
    """
    found: list[_Phrase] = []
    preposition, start = Preposition(""), 0
    for i in range(len(words) + 1):
        following = match_preposition(lex, words, i) if start <= i < len(words) else None
        if i < start or (following is None and i < len(words)):
            continue
        piece = _without_particles(lex, words[start:i])
        before = found[-1].words if found else ()
        if together := _part_and_place(lex, before, preposition, piece):
            found[-1] = _Phrase(found[-1].preposition, together)
        else:
            found.append(_Phrase(preposition, piece))
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


def _goal_at(operation: str, phrases: list[_Phrase]) -> int:
    """Which phrase says where the target goes; behind the last if none does."""
    said = [(i, phrase.preposition) for i, phrase in enumerate(phrases)]
    free = [(i, one) for i, one in said if not (one.place or one.is_source or one.is_relative)]
    if operation not in ("put", "push", "pick"):
        return len(phrases)
    if goals := [i for i, one in free if one.is_goal]:
        return goals[0]
    if operation == "pick" or not free:
        return len(phrases)
    # "on the plate next to the stove": the stove tells which plate.
    supporting = [i for i, one in free if one.relation in ("on", "in", "under")]
    return supporting[-1] if supporting else free[-1][0]


def _which(lex: Lexicon, noun: Noun, phrases: list[_Phrase]) -> Noun:
    """Give a noun the phrase that tells which of several it is."""
    if not phrases:
        return noun
    preposition, words = phrases[-1].preposition, phrases[-1].words
    if preposition.place:
        return replace(noun, where=Reference(preposition.place))
    nouns = [one for one in read_nouns(lex, words) if one.name]
    if not nouns:
        return noun
    if nouns[0].part in lex.places.values():  # "from the table's centre"
        return replace(noun, where=Reference("center", (nouns[0].name,)))
    relation = preposition.relation
    if relation in ("", "at"):
        relation = "in" if nouns[0].part or nouns[0].name.split()[-1] in lex.hollow else "on"
    relation = {"behind": "back"}.get(relation, relation.removesuffix(" of"))
    return replace(noun, where=Reference(relation, tuple(one.name for one in nouns)))
