"""Read an instruction: the sub-tasks it asks for, in the order of execution."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.clauses import Said, read_clause
from lerobot_openspm.language.completeness import says_all
from lerobot_openspm.language.lexicon import ENGLISH, Lexicon
from lerobot_openspm.language.own_words import normal_words, unread
from lerobot_openspm.language.phrases import Noun
from lerobot_openspm.language.pronouns import POINTING, Resolver, is_there
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
        return tuple(_as_known(lex, sub_task, names) for sub_task in _parse(lex, instruction))
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


def _parse(lex: Lexicon, instruction: str) -> tuple[SubTask, ...]:
    clauses = read_clauses(lex, instruction)
    said: list[Said] = []
    for clause in clauses:
        said.append(read_clause(lex, clause, said[-1] if said else None))
    if len(said) > 1 and not said[-1].operation and said[-2].landmark:  # "... and then the tomato sauce"
        said[-1] = replace(said[-2], targets=said[-1].targets)
    if not any(one.operation for one in said):
        raise InstructionError("states something; say what to do")
    sub_tasks = _merged(sorted(_resolve_all(lex, clauses, said), key=lambda one: one.step))
    if nameless := [s.operation for s in sub_tasks if not s.target or bool(s.relation) != bool(s.landmark)]:
        raise InstructionError(f"names no object after {nameless[0]!r}")
    return sub_tasks


def _resolve_all(lex: Lexicon, clauses: Sequence[Clause], said: Sequence[Said]) -> list[_Meant]:
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
        sub_tasks = Resolver(lex, [s for one in meant for s in one.sub_tasks], topic).resolve(said[i])
        is_done = clauses[i].is_done or said[i].is_state or is_there(said[i])
        meant.append(_Meant(sub_tasks, clauses[i].step, is_done))
        topic = None
    return meant


def _lacks_noun(said: Said) -> bool:
    nouns = (*said.targets, *([said.landmark] if said.landmark else []))
    return any(noun.pronoun in POINTING for noun in nouns)


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
        (s.operation, s.target, s.target_where) == (PICK, sub_task.target, sub_task.target_where)
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
