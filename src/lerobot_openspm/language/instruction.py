"""From an instruction to its task elements, by a small grammar and a table of words. No download.

:func:`read_task` is how mining, teaching and acting read: any wording is a task, structure a bonus.

``wording`` makes plain imperatives of other ways to ask, ``sentences`` splits them into clauses, ``clauses``
reads a verb with its ``nouns`` and ``prepositions``; here clauses become sub-tasks and pronouns get nouns.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.language.clauses import Said, read_clause
from lerobot_openspm.language.loose_reading import read_loosely
from lerobot_openspm.language.loose_words import THINGS
from lerobot_openspm.language.names import canonical_name
from lerobot_openspm.language.nouns import Noun
from lerobot_openspm.language.own_words import normal_words, unread
from lerobot_openspm.language.sense import makes_sense, says_all
from lerobot_openspm.language.sentences import MAX_CHARACTERS, Clause, read_clauses
from lerobot_openspm.types import Reference, SubTask

PICK = "pick"


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


def read_task(instruction: str, names: Collection[str] = frozenset()) -> tuple[SubTask, ...]:
    """Read any task: its elements where the grammar has them, else one sub-task kept by its own words.

    Args:
        instruction: What is asked or was demonstrated, in any words and any language.
        names: Names of the things that the memory holds.

    Raises:
        InstructionError: There is not a word in it.
    """
    try:
        found = parse_instruction(instruction, names)
    except InstructionError:
        return (unread(instruction),)
    return found if says_all(found, instruction) else (unread(instruction),)


def read_tasks(
    instructions: Iterable[str], names: Collection[str] = frozenset()
) -> dict[str, tuple[SubTask, ...]]:
    """Read tasks that are to be learned: what one of them names is known in all, as it will be when acting.

    Things keep the names that they are given here, also where the memory has one of their kind: to take two
    things for one is worse than to learn one twice. An instruction without a word is left out.
    """
    told = [one for one in dict.fromkeys(instructions) if normal_words(one)]
    named = {name for one in told for sub_task in read_task(one) for name in sub_task.objects}
    return {one: read_task(one, {*names, *named}) for one in told}


def parse_instruction(instruction: str, names: Collection[str] | None = None) -> tuple[SubTask, ...]:
    """Read what is to be done, in the order of execution.

    "open the top drawer and put the bowl inside" gives two sub-tasks, the second with the cabinet of the
    first as its landmark. "pick up the bowl on the stove and put it on the plate" gives one: where a thing is
    picked up tells which is meant, not where it goes. A sentence that the grammar cannot read, or only with
    words left over, is read from its elements wherever they stand (``loose_reading``).

    Args:
        instruction: What is asked.
        names: Names of the things that the memory holds. A thing keeps the name that it is given, unless the
            memory has none of that name and one of its kind: "cupboard", where a cabinet is known. Without a
            memory, things are called by their kind.

    Raises:
        InstructionError: It is no instruction to do something (a question, a statement, a negation, a
            condition), no verb of the grammar is in it, or the verb has no object.
    """
    try:
        found = _read_twice(instruction, THINGS | frozenset(names or ()))
        return tuple(_as_known(sub_task, names) for sub_task in found)
    except InstructionError as error:
        shown = instruction if len(instruction) <= MAX_CHARACTERS else f"{instruction[:60]} ..."
        raise InstructionError(f"the instruction {shown!r} {error}") from None


def _as_known(sub_task: SubTask, names: Collection[str] | None) -> SubTask:
    """A sub-task with the names that the memory has for its things."""

    def known(name: str) -> str:
        kind = v.kind(name)
        if names is None or not name:
            return kind
        alike = [] if name in names else [other for other in names if v.kind(other) == kind]
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


def _read_twice(instruction: str, things: Collection[str]) -> tuple[SubTask, ...]:
    """By the grammar; from the elements where that fails or leaves words unexplained."""
    found: tuple[SubTask, ...] = ()
    refusal = InstructionError("")
    try:
        found = _parse(instruction)
    except InstructionError as error:
        refusal = error
    if found and makes_sense(found, things):
        return found
    try:
        loose = read_loosely(instruction, things)
        if makes_sense(loose, things):
            return loose
    except InstructionError:
        pass  # what the grammar says of it is of more use
    if not found:
        raise refusal
    return found


def _parse(instruction: str) -> tuple[SubTask, ...]:
    clauses = read_clauses(instruction)
    said: list[Said] = []
    for clause in clauses:
        said.append(read_clause(clause, said[-1] if said else None))
    if len(said) == 1 and said[0].operation == PICK and clauses[0].words[0] == "get":
        said = [
            read_clause(replace(clauses[0], words=("put", *clauses[0].words[1:])), None)
        ]  # "get it on the plate"
    if len(said) > 1 and not said[-1].operation and said[-2].landmark:  # "... and then the tomato sauce"
        said[-1] = replace(said[-2], targets=said[-1].targets)
    if not any(one.operation for one in said):
        raise InstructionError("states something; say what to do")
    sub_tasks = _merged(sorted(_resolve_all(clauses, said), key=lambda one: one.step))
    if nameless := [s.operation for s in sub_tasks if not s.target or bool(s.relation) != bool(s.landmark)]:
        raise InstructionError(f"names no object after {nameless[0]!r}")
    return sub_tasks


def _resolve_all(clauses: Sequence[Clause], said: Sequence[Said]) -> list[_Meant]:
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
            if following not in ("it", "them"):
                raise InstructionError(f"states something of {topic.name or 'it'!r}; say what to do")
            continue
        sub_tasks = _Resolver([s for one in meant for s in one.sub_tasks], topic).resolve(said[i])
        is_done = clauses[i].is_done or said[i].is_state or _is_there(said[i])
        meant.append(_Meant(sub_tasks, clauses[i].step, is_done))
        topic = None
    return meant


def _is_there(said: Said) -> bool:
    """Whether it goes where was said before: "the bowl belongs on the stove, put it there"."""
    return said.landmark is not None and (said.relation, said.landmark.pronoun) == ("at", "there")


def _lacks_noun(said: Said) -> bool:
    nouns = (*said.targets, *([said.landmark] if said.landmark else []))
    return any(noun.pronoun in ("it", "them", "there") for noun in nouns)


@dataclass(frozen=True)
class _Resolver:
    """Gives pronouns their nouns.

    Attributes:
        before: The sub-tasks said before.
        topic: What is spoken of, if a clause named just that.
    """

    before: Sequence[SubTask]
    topic: Noun | None

    def resolve(self, said: Said) -> tuple[SubTask, ...]:
        """One sub-task for each target, and for each of several that are counted."""
        targets = [t for noun in said.targets for t in self._targets(noun, said.operation)]
        if not said.landmark:
            return tuple(
                SubTask(said.operation, t.name, t.part, target_where=t.where)
                for t in targets
                for _ in range(t.count)
            )
        landmark = self._landmark(said.landmark, said.relation, targets[-1])
        if _is_there(said) and self.before and self.before[-1].relation:
            said = replace(said, relation=self.before[-1].relation)
        part = landmark.part
        if said.relation == "on" and part.endswith("drawer"):
            part = ""  # what is put on a drawer stands on the cabinet
        return tuple(
            SubTask(
                said.operation, t.name, t.part or part, said.relation, landmark.name, t.where, landmark.where
            )
            for t in targets
            for _ in range(t.count)
        )

    def _targets(self, noun: Noun, operation: str) -> list[Noun]:
        last = self.before[-1] if self.before else None
        if last and noun.count > 1 and noun.name == last.target == last.landmark:  # "the two bowls", stacked
            noun = Noun(pronoun="them")
        if noun.pronoun not in ("it", "them", "there"):
            return [self._named(noun, operation)]
        if self.topic is not None:
            return [self.topic]
        if last is None:
            raise InstructionError(f"names no object after {operation!r}")
        landmark = Noun(last.landmark, last.part, last.landmark_where)
        target = Noun(last.target, "" if last.landmark else last.part, last.target_where)
        if operation in ("open", "close") and last.relation == "in":
            return [landmark]
        if operation in ("turn on", "turn off") and last.landmark:
            return [landmark]
        if noun.pronoun == "them":
            if last.operation == "put" and last.relation in ("on", "in") and len(self._together()) == 1:
                return [landmark]  # of two that are stacked, the lower one carries the other
            return self._together()
        return [target]

    def _together(self) -> list[Noun]:
        """The targets of the last sub-tasks of one operation and one landmark: "them"."""
        last = self.before[-1]
        same = [s for s in self.before if (s.operation, s.landmark) == (last.operation, last.landmark)]
        return [Noun(s.target, "", s.target_where) for s in same]

    def _landmark(self, noun: Noun, relation: str, target: Noun) -> Noun:
        if noun.pronoun == "one":
            last = self.before[-1] if self.before else None
            if last and last.landmark and not noun.name:  # "... on the left plate, ... on the right one"
                return replace(noun, name=last.landmark, pronoun="")
            return self._named(noun, "put", target)
        if noun.pronoun not in ("it", "them", "there"):
            return self._named(noun, "put")
        before = [s for s in self.before if s.operation != PICK or s.target != target.name or s.landmark]
        if not before:
            raise InstructionError(f"names no object after {relation!r}")
        last = before[-1]
        beside = relation not in ("in", "on", "at") or noun.pronoun == "there"
        is_holder = canonical_name(last.target).split()[-1] in v.HOLLOW
        if last.landmark and (beside or last.target == target.name or (relation == "in" and not is_holder)):
            return Noun(last.landmark, last.part, last.landmark_where)
        return Noun(last.target, last.part, last.target_where)

    def _named(self, noun: Noun, operation: str, target: Noun | None = None) -> Noun:
        """A noun that leans on another: "the white one", "its top drawer", "the drawer", "the door"."""
        if not self.before and target is None:
            return self._whole(noun)
        if noun.pronoun == "one":
            name = target.name if target else self.before[-1].target
            if (
                noun.name in v.HEIGHTS and self.before and self.before[-1].part
            ):  # "the bottom one", of drawers
                part = f"{v.HEIGHTS[noun.name]} {self.before[-1].part.split()[-1]}"
                return Noun(self.before[-1].landmark or name, part)
            return replace(noun, name=f"{noun.name} {name.split()[-1]}" if noun.name else name, pronoun="")
        last = self.before[-1] if self.before else None
        if last is None:
            return self._whole(noun)
        if noun.pronoun == "its":
            name = last.target if not last.landmark else last.landmark
            return replace(noun, name=name, pronoun="")
        if noun.name == "door":
            return Noun(last.landmark or last.target, "")
        parts = [s for s in self.before if noun.part in v.PART_OF and s.part.endswith(f" {noun.part}")]
        if parts:
            owner = parts[-1].landmark or parts[-1].target
            return replace(noun, name=owner, part=parts[-1].part)
        return self._whole(noun)

    def _whole(self, noun: Noun) -> Noun:
        if noun.pronoun:
            raise InstructionError(f"does not say what {noun.pronoun!r} is")
        return replace(noun, part="") if noun.part == "door" else noun


def _is_vaguer(one: SubTask, other: SubTask) -> bool:
    """Whether another says the same more exactly: "to the rack", "on the rack"."""
    return one.relation == "at" != other.relation and replace(one, relation=other.relation) == other


def _is_taken(found: Sequence[SubTask], sub_task: SubTask) -> bool:
    return not sub_task.landmark and any(
        (s.operation, s.target, s.target_where) == (PICK, sub_task.target, sub_task.target_where)
        for s in found
    )


def _merged(meant: Sequence[_Meant]) -> tuple[SubTask, ...]:
    """Join what is taken with where it is put, and leave out what is said twice."""
    found: list[SubTask] = []
    for one in meant:
        before = tuple(found)
        for sub_task in one.sub_tasks:
            if one.is_done and sub_task in before:
                continue
            if one.is_done and found and replace(found[-1], operation="push") == sub_task:
                found.pop()  # "the plate belongs in front of the stove, push it there"
            if sub_task.operation == PICK and _is_taken(found, sub_task):
                continue  # "find the milk, pick it up"
            taken = next((s for s in found if s.operation == PICK and s.target == sub_task.target), None)
            if taken is not None and sub_task.operation == "put":
                found.remove(taken)
                sub_task = replace(sub_task, target_where=sub_task.target_where or taken.target_where)
            if found and _is_vaguer(found[-1], sub_task):
                found.pop()
            found.append(sub_task)
    return tuple(replace(s, operation="put") if s.operation == PICK else s for s in found)
