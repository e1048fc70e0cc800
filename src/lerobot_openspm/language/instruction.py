"""Read an instruction: the sub-tasks it asks for, in the order of execution."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.clauses import Said, find_verb, read_phrases
from lerobot_openspm.language.completeness import says_all
from lerobot_openspm.language.lexicon import ENGLISH, Lexicon
from lerobot_openspm.language.own_words import normal_words, unread
from lerobot_openspm.language.phrases import Noun
from lerobot_openspm.language.sentences import (
    MAX_CHARACTERS,
    Clause,
    as_clauses,
    read_sentences,
    split_sentence,
)
from lerobot_openspm.types import Reference, SubTask

_PICK = "pick"
_POINTING = ("it", "them", "there")
_POLITE = re.compile(r"\bplease\b|\bkindly\b")


@dataclass(frozen=True)
class _Meant:
    """What a clause means: its sub-tasks, and its place in the order of execution.

    Attributes:
        sub_tasks: One for each of its targets; of operation "pick" where something is only taken.
        step: Its place.
        is_done: Whether it says what is done by then, or how something is to be.
    """

    sub_tasks: tuple[SubTask, ...]
    step: int
    is_done: bool = False


def read_task(
    instruction: str, names: Collection[str] = frozenset(), lex: Lexicon = ENGLISH
) -> tuple[SubTask, ...]:
    """Read any task: its elements where the grammar has them, else one sub-task kept by its own words.

    Args:
        instruction: What is asked or was demonstrated, in any words and any language.
        names: Names of the things that the memory holds.
        lex: The words that it is read by.

    Raises:
        InstructionError: There is not a word in it.
    """
    try:
        found = parse_instruction(instruction, names, lex)
    except InstructionError:
        return (unread(instruction, lex),)
    return found if says_all(lex, found, instruction) else (unread(instruction, lex),)


def read_tasks(
    instructions: Iterable[str], names: Collection[str] = frozenset(), lex: Lexicon = ENGLISH
) -> dict[str, tuple[SubTask, ...]]:
    """Read tasks that are to be learned: what one of them names is known in all, as it will be when acting.

    Things keep the names that they are given here, also where the memory has one of their kind: to take two
    things for one is worse than to learn one twice. An instruction without a word is left out.
    """
    told = [one for one in dict.fromkeys(instructions) if normal_words(one, lex)]
    named = {name for one in told for sub_task in read_task(one, lex=lex) for name in sub_task.objects}
    return {one: read_task(one, {*names, *named}, lex) for one in told}


def parse_instruction(
    instruction: str, names: Collection[str] | None = None, lex: Lexicon = ENGLISH
) -> tuple[SubTask, ...]:
    """Read what is to be done, in the order of execution.

    "open the top drawer and put the bowl inside" gives two sub-tasks, the second with the cabinet of the
    first as its landmark. "pick up the bowl on the stove and put it on the plate" gives one: where a thing is
    picked up tells which is meant, not where it goes.

    Args:
        instruction: What is asked.
        names: Names of the things that the memory holds. A thing keeps the name that it is given, unless the
            memory has none of that name and one of its kind: "cupboard", where a cabinet is known. Without a
            memory, things are called by their kind.
        lex: The words that it is read by.

    Raises:
        InstructionError: It is no instruction to do something (a question, a statement, a negation, a
            condition), no verb of the grammar is in it, or the verb has no object.
    """
    try:
        sentences = [split_sentence(lex, words) for words in read_sentences(lex, instruction)]
        clauses = as_clauses(lex, sentences, _POLITE.search(instruction.lower()) is not None)
        said: list[Said] = []
        for clause in clauses:
            before = said[-1] if said else None
            said.append(read_phrases(lex, find_verb(lex, clause, before), before))
        if len(said) > 1 and not said[-1].operation and said[-2].landmark:  # "and then the tomato sauce"
            said[-1] = replace(said[-2], targets=said[-1].targets)
        if not any(one.operation for one in said):
            raise InstructionError("states something; say what to do")
        sub_tasks = _merged(sorted(_resolved(lex, clauses, said), key=lambda one: one.step))
        for one in sub_tasks:
            if not one.target or bool(one.relation) != bool(one.landmark):
                raise InstructionError(f"names no object after {one.operation!r}")
        return tuple([_as_known(lex, one, names) for one in sub_tasks])
    except InstructionError as error:
        shown = instruction if len(instruction) <= MAX_CHARACTERS else f"{instruction[:60]} ..."
        raise InstructionError(f"the instruction {shown!r} {error}") from None


def _as_known(lex: Lexicon, sub_task: SubTask, names: Collection[str] | None) -> SubTask:
    """A sub-task with the names that the memory has for its things."""

    def known(name: str) -> str:
        kind = lex.kind(name)
        if names is None or not name:
            return kind
        alike = [] if name in names else [other for other in names if lex.kind(other) == kind]
        return alike[0] if len(alike) == 1 else name

    def there(where: Reference | None) -> Reference | None:
        return None if where is None else replace(where, landmarks=tuple(map(known, where.landmarks)))

    return replace(
        sub_task,
        target=known(sub_task.target),
        landmark=known(sub_task.landmark),
        target_where=there(sub_task.target_where),
        landmark_where=there(sub_task.landmark_where),
    )


def _resolved(lex: Lexicon, clauses: Sequence[Clause], said: Sequence[Said]) -> list[_Meant]:
    """Give pronouns their nouns: from what was said before, else from what is to be done before."""
    order = list(range(len(said)))
    if _lacks_noun(said[0]):  # "before putting the bowl inside, open the drawer"
        order.sort(key=lambda i: clauses[i].step)
    meant: list[_Meant] = []
    topic: Noun | None = None
    for i in order:
        if not said[i].operation:
            topic = said[i].targets[0]
            following = said[i + 1].targets[0].pronoun if i + 1 < len(said) else ""
            if following not in ("it", "them", "one"):
                raise InstructionError(f"states something of {topic.name or 'it'!r}; say what to do")
            continue
        sub_tasks = _Resolver(lex, [s for one in meant for s in one.sub_tasks], topic).resolve(said[i])
        is_done = clauses[i].is_done or said[i].is_state or _is_there(said[i])
        meant.append(_Meant(sub_tasks, clauses[i].step, is_done))
        topic = None
    return meant


def _lacks_noun(said: Said) -> bool:
    nouns = (*said.targets, *([said.landmark] if said.landmark else []))
    return any(noun.pronoun in _POINTING for noun in nouns)


def _is_vaguer(one: SubTask, other: SubTask) -> bool:
    """Whether another says the same more exactly: "to the rack", "on the rack"."""
    return one.relation == "at" != other.relation and replace(one, relation=other.relation) == other


def _is_said_again(sub_task: SubTask, other: SubTask) -> bool:
    """Whether they are one but for what is left out of the target's name, or of where it is."""
    words, more = set(sub_task.target.split()), set(other.target.split())
    where = sub_task.target_where or other.target_where
    is_one = replace(sub_task, target=other.target, target_where=where) == other
    return is_one and (words <= more or more <= words)


def _is_taken(found: Sequence[SubTask], sub_task: SubTask) -> bool:
    return not sub_task.landmark and any(
        (s.operation, s.target, s.target_where) == (_PICK, sub_task.target, sub_task.target_where)
        for s in found
    )


def _merged(meant: Sequence[_Meant]) -> tuple[SubTask, ...]:
    """Join what is taken with where it is put, and leave out what is said twice."""
    found: list[SubTask] = []
    for one in meant:
        before = tuple(found)
        for sub_task in one.sub_tasks:
            if one.is_done and any(_is_said_again(sub_task, other) for other in before):
                continue
            if one.is_done and found and replace(found[-1], operation="push") == sub_task:
                found.pop()  # "the plate belongs in front of the stove, push it there"
            if sub_task.operation == _PICK and _is_taken(found, sub_task):
                continue  # "find the milk, pick it up"
            taken = next((s for s in found if s.operation == _PICK and s.target == sub_task.target), None)
            if taken is not None and sub_task.operation == "put":
                found.remove(taken)
                sub_task = replace(sub_task, target_where=sub_task.target_where or taken.target_where)
            if found and _is_vaguer(found[-1], sub_task):
                found.pop()
            found.append(sub_task)
    return tuple(replace(s, operation="put") if s.operation == _PICK else s for s in found)


def _is_there(said: Said) -> bool:
    """Whether it goes where was said before: "the bowl belongs on the stove, put it there"."""
    return said.landmark is not None and (said.relation, said.landmark.pronoun) == ("at", "there")


@dataclass(frozen=True)
class _Resolver:
    """Gives pronouns their nouns.

    Attributes:
        lex: The words.
        before: The sub-tasks said before.
        topic: What is spoken of, if a clause named just that.
    """

    lex: Lexicon
    before: Sequence[SubTask]
    topic: Noun | None

    def resolve(self, said: Said) -> tuple[SubTask, ...]:
        """One sub-task for each target, and for each of several that are counted."""
        targets = [t for noun in said.targets for t in self._targets(noun, said.operation)]
        relation, landmark = said.relation, Noun()
        if said.landmark:
            landmark = self._landmark(said.landmark, relation, targets[-1])
            if _is_there(said) and self.before:
                relation = self.before[-1].relation or relation
        # What is put on a drawer stands on the cabinet.
        part = "" if relation == "on" and landmark.part.endswith("drawer") else landmark.part
        return tuple(
            SubTask(said.operation, t.name, t.part or part, relation, landmark.name, t.where, landmark.where)
            for t in targets
            for _ in range(t.count)
        )

    def _targets(self, noun: Noun, operation: str) -> list[Noun]:
        if noun.pronoun not in _POINTING:
            return [self._named(noun)]
        if self.topic is not None:
            return [self.topic]
        if not self.before:
            raise InstructionError(f"names no object after {operation!r}")
        last = self.before[-1]
        landmark = Noun(last.landmark, last.part, last.landmark_where)
        if operation in ("open", "close") and last.relation == "in":
            return [landmark]
        if operation in ("turn on", "turn off") and last.landmark:
            return [landmark]
        if noun.pronoun != "them":
            return [Noun(last.target, "" if last.landmark else last.part, last.target_where)]
        same = [s for s in self.before if (s.operation, s.landmark) == (last.operation, last.landmark)]
        if last.relation in ("on", "in") and len(same) == 1:
            return [landmark]  # of two that are stacked, the lower one carries the other
        return [Noun(s.target, "", s.target_where) for s in same]

    def _landmark(self, noun: Noun, relation: str, target: Noun) -> Noun:
        if noun.pronoun == "one" and not noun.name and self.before and self.before[-1].landmark:
            return replace(noun, name=self.before[-1].landmark, pronoun="")  # "... on the right one"
        if noun.pronoun not in _POINTING:
            return self._named(noun, target if noun.pronoun == "one" else None)
        before = [s for s in self.before if s.operation != "pick" or s.target != target.name or s.landmark]
        if not before and target.where and target.where.landmarks:
            return Noun(target.where.landmarks[0])  # "the bowl beside the plate should be on it"
        if not before:
            raise InstructionError(f"names no object after {relation!r}")
        last = before[-1]
        beside = relation not in ("in", "on", "at") or noun.pronoun == "there" or last.target == target.name
        is_holder = self.lex.canonical(last.target).split()[-1] in self.lex.hollow
        if last.landmark and (beside or (relation == "in" and not is_holder)):
            return Noun(last.landmark, last.part, last.landmark_where)
        return Noun(last.target, last.part, last.target_where)

    def _named(self, noun: Noun, target: Noun | None = None) -> Noun:
        """A noun that leans on another: "the white one", "its top drawer", "the drawer", "the door"."""
        last = self.before[-1] if self.before else None
        spoken_of = target or self.topic
        if noun.pronoun == "one" and last and last.part and noun.name in self.lex.heights:  # of drawers
            part = f"{self.lex.heights[noun.name]} {last.part.split()[-1]}"
            return Noun(last.landmark or last.target, part)
        if noun.pronoun == "one" and (spoken_of or last):
            name = spoken_of.name if spoken_of else last.target if last else ""
            return replace(noun, name=f"{noun.name} {name.split()[-1]}" if noun.name else name, pronoun="")
        if last and noun.pronoun == "its":
            return replace(noun, name=last.landmark or last.target, pronoun="")
        if last and noun.name == "door":
            return Noun(last.landmark or last.target)
        if noun.pronoun:
            raise InstructionError(f"does not say what {noun.pronoun!r} is")
        parts = [s for s in self.before if noun.part in self.lex.parts and s.part.endswith(f" {noun.part}")]
        if parts:
            return replace(noun, name=parts[-1].landmark or parts[-1].target, part=parts[-1].part)
        return replace(noun, part="") if noun.part == "door" else noun
