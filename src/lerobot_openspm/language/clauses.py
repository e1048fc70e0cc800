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
    Phrase,
    match_preposition,
    read_noun,
    read_nouns,
    split_phrases,
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
class Told:
    """The verb of a clause, and the words that it holds for.

    Attributes:
        verb: The verb; where none is said, what is meant to be done.
        words: What it is done to, with the phrases behind it.
        is_state: See :class:`Said`.
        is_same: Whether all but the thing is as in the clause before.
        goes_on: Whether the verb is that of the clause before.
    """

    verb: Verb
    words: Words
    is_state: bool = False
    is_same: bool = False
    goes_on: bool = False


def find_verb(lex: Lexicon, clause: Clause, before: Said | None) -> Told:
    """Find what is done in a clause; `before` is the clause before it, whose verb may hold here too.

    Raises:
        InstructionError: It has no verb.
    """
    words = clause.words
    if clause.is_same and before is not None:
        return Told(_unsaid(""), words, is_same=True)
    if not clause.is_seen:
        words = _verb_first(lex, words)
        forms: tuple[Form, ...] = ("base", "gerund", "participle") if clause.is_done else ("base", "gerund")
        if verb := lex.match_verb(words, 0, *forms):
            return Told(verb, words[verb.length :])
    if told := _without_verb(lex, clause, words, before):
        return told
    if clause.is_seen or words[0] in lex.determiners or len(words) == 1 or WHICH in words:
        return Told(_unsaid(""), _spoken_of(lex, words))  # "the bowl is on the plate", or a thing alone
    raise InstructionError(f"has no verb I know in {' '.join(words)!r} (such as {_USUAL_VERBS})")


def read_phrases(lex: Lexicon, told: Told, before: Said | None) -> Said:
    """Read what is done to what, and where that goes; `before` is the clause before.

    Raises:
        InstructionError: Nothing is named that it is done to, or a noun phrase cannot be read.
    """
    if told.is_same and before is not None:
        return replace(before, targets=tuple(read_nouns(lex, told.words)))
    operation, words = _operation(lex, told)
    head, *phrases = split_phrases(lex, words)
    if not operation:
        return Said("", (_which(lex, read_noun(lex, head.words), phrases[:1]),))
    targets = tuple(read_nouns(lex, head.words)) or (IMPLIED,)
    if not all(noun.name or noun.pronoun for noun in targets):
        raise InstructionError(f"names no object after {operation!r}")
    if _may_open(told.verb) and words == told.words:
        drawer = _which(lex, targets[-1], phrases)
        if drawer.part and drawer.where is None:
            return Said("open", (drawer,), is_state=told.is_state)
        operation = _own_operation(told.verb)
    at = _goal_at(operation, phrases)
    sources = [phrase for phrase in phrases[at + 1 :] if phrase.preposition.is_source]
    targets = (*targets[:-1], _which(lex, targets[-1], [*phrases[:at], *sources]))
    if at == len(phrases):
        is_taken = operation == "put" and any(phrase.preposition.is_source for phrase in phrases)
        said = Said("pick" if is_taken else operation, targets)  # "bring the bowl down from the cabinet"
    else:
        relation, noun = _goal(lex, phrases[at])
        after = [phrase for phrase in phrases[at + 1 :] if not phrase.preposition.is_source]
        said = Said(operation, targets, relation, _which(lex, noun, after))
    if told.verb.word == "slide" and said.relation in _LIFTING_RELATIONS and not told.is_state:
        return replace(said, operation="put")
    if told.goes_on and before is not None:
        return _of_other_place(said, before)
    return replace(said, is_state=told.is_state)


def _operation(lex: Lexicon, told: Told) -> tuple[str, Words]:
    """What a verb means, which may be split around its object: "turn the stove on"; and the words left."""
    verb, words = told.verb, told.words
    end = words[-1] if len(words) > 1 else ""
    if verb.length == 1 and verb.word in lex.switches and end in ("on", "off"):
        return f"turn {end}", words[:-1]
    if verb.length == 1 and verb.word in lex.motions:
        if end in lex.results:
            return lex.results[end], words[:-1]
        thing = words[:-2] if words[-2:-1] == ("back",) else words[:-1]
        if end in lex.drawer_results and read_noun(lex, thing).part:
            return lex.drawer_results[end], thing
    return "open" if _may_open(verb) else _own_operation(verb), words


def _may_open(verb: Verb) -> bool:
    """Whether a verb opens what has a part to open: "pull the top drawer"."""
    return verb.length == 1 and verb.word in ("pull", "draw")


def _own_operation(verb: Verb) -> str:
    """What a verb means by itself."""
    if verb.operation == HALF_A_VERB:
        raise InstructionError(
            f"has no verb I know in {verb.word!r} alone; say what becomes of it: open, on, off"
        )
    return verb.operation


def _goal(lex: Lexicon, phrase: Phrase) -> tuple[str, Noun]:
    """The relation and the landmark that a phrase says."""
    relation = phrase.preposition.relation
    noun = read_noun(lex, phrase.words) if phrase.words else Noun(pronoun="there")
    if relation == "center":
        relation = "on"  # "in the middle of the plate"
    elif relation == "at" and noun.part:
        relation = "in"  # "to the right compartment"
    if phrase.preposition.is_inside and (part := lex.parts_by_place.get(lex.kind(noun.name))):
        return "in", replace(noun, part=f"{PLACE_OF_RELATION[relation]} {part}")
    return relation, noun


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


def _spoken_of(lex: Lexicon, words: Words) -> Words:
    at = next((i for i, word in enumerate(words) if word in ("is", "are")), len(words))
    has_phrase = any(match_preposition(lex, words, i) for i in range(at, len(words) - 1))
    return (*words[:at], *words[at + 1 :]) if has_phrase else words[:at]  # "the drawer is open"


def _without_verb(lex: Lexicon, clause: Clause, words: Words, before: Said | None) -> Told | None:
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


def _predicate(lex: Lexicon, clause: Clause, words: Words, at: int) -> Told | None:
    """Read a subject and, from a word on, what it is to be: "the bowl | should be put on the plate"."""
    end = at
    while end < len(words) and words[end] in lex.auxiliaries and words[end + 1 : end + 2] != ("the",):
        end += 1
    while at > 1 and words[at - 1] in lex.auxiliaries:
        at -= 1
    is_told = bool(set(words[at:end]) & lex.modals) or clause.is_done or clause.is_wanted
    subject, rest = words[:at], words[end:]
    if rest[:1] and rest[0] in lex.goes:
        return Told(_unsaid("put"), (*subject, *rest[1:]))
    return _state(lex, subject, rest) if is_told and rest else None


def _verbless(lex: Lexicon, clause: Clause, words: Words, before: Said | None) -> Told | None:
    """Read a thing and where it goes: "and the bottle on the rack", "ketchup into the basket"."""
    relations = [i for i in range(1, len(words)) if match_preposition(lex, words, i)]
    if not relations:
        return None
    if before is not None and before.operation in ("put", "push"):
        return Told(_unsaid(before.operation), words, goes_on=True)
    last = match_preposition(lex, words, relations[-1])
    is_thing = relations[0] == 1 or words[0] in lex.determiners
    if not clause.is_wanted and not (last and last.is_goal and is_thing):
        return None
    told = Told(_unsaid("put"), words)
    if WHICH in words and read_phrases(lex, told, before).landmark is None:
        # "I'd like the bottle standing on the cabinet"
        return replace(told, words=tuple(word for word in words if word != WHICH))
    return told


def _is_participle(lex: Lexicon, words: Words, at: int) -> bool:
    """Whether a word says what is done to the noun before it: "placed", but not "left" in "the left mug"."""
    verb = lex.match_verb(words, at, "participle")
    end = at + verb.length if verb else at
    return end > at and (end == len(words) or match_preposition(lex, words, end) is not None)


def _of_other_place(said: Said, before: Said) -> Said:
    """Complete "and the other mug on the right", after "the mug on the left plate"."""
    where = said.targets[-1].where
    if said.landmark is not None or before.landmark is None or where is None or where.landmarks:
        return said
    targets = (*said.targets[:-1], replace(said.targets[-1], where=None))
    return replace(
        said, targets=targets, relation=before.relation, landmark=replace(before.landmark, where=where)
    )


def _state(lex: Lexicon, subject: Words, rest: Words) -> Told | None:
    """What is to be done so that a subject is as said: "open", "on", "placed on it", "on the plate"."""
    at = next((i for i, word in enumerate(rest[:-1]) if word not in lex.stands | lex.goes), len(rest) - 1)
    rest = rest[at:]
    if verb := lex.match_verb(rest, 0, "participle", "gerund"):
        return Told(verb, (*subject, *rest[verb.length :]), is_state=True)
    if operation := f"turn {rest[0]}" if rest in (("on",), ("off",)) else lex.results.get(" ".join(rest)):
        return Told(_unsaid(operation), subject, is_state=True)
    is_place = match_preposition(lex, rest, 0) is not None
    return Told(_unsaid("put"), (*subject, *rest), is_state=True) if is_place else None


def _unsaid(operation: str) -> Verb:
    """What is meant where no verb is said; "" for what is only spoken of."""
    return Verb(operation, "", 0)


def _goal_at(operation: str, phrases: list[Phrase]) -> int:
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


def _which(lex: Lexicon, noun: Noun, phrases: list[Phrase]) -> Noun:
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
