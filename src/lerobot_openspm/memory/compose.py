"""Compound tasks: what an entry teaches by its parts, and by which entries an instruction is carried out.

"open the top drawer and put the bowl inside" also teaches "open the top drawer". An instruction that no
demonstration shows as a whole is carried out by entries of its parts, one after another. A part that none
shows either is put together from a grasp and a place, see :mod:`~lerobot_openspm.memory.combine`.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.descriptions import phrase
from lerobot_openspm.language.lexicon import Lexicon
from lerobot_openspm.language.meaning import same_meaning, semantic_score
from lerobot_openspm.language.names import TABLE_NAMES, AmongKnown, NameSimilarity
from lerobot_openspm.language.own_words import split_steps
from lerobot_openspm.memory.combine import combinations
from lerobot_openspm.memory.entry import CONTACT_PHASES, MemoryEntry, RetrievalKey
from lerobot_openspm.memory.indexed_entries import near
from lerobot_openspm.memory.looks import UNKNOWN_LOOKS, Looks
from lerobot_openspm.memory.retrieval import MIN_SEMANTIC, candidates_for, read_instruction, why_unread
from lerobot_openspm.types import SubTask

# A sub-task takes hold of something and lets it go again.
TRANSITIONS_PER_SUB_TASK = 2


@dataclass(frozen=True)
class Candidate:
    """An entry that a part of an instruction can be carried out by.

    Attributes:
        entry: What is executed: an entry of the memory, or one sub-task of it.
        semantic: Its ``S_sem``.
        sources: The entry of the memory; of what was put together, that of the grasp and that of the place.
        asked: What of the instruction it carries out, one for each of the entry's sub-tasks.
    """

    entry: MemoryEntry
    semantic: float
    sources: tuple[MemoryEntry, ...]
    asked: tuple[SubTask, ...] = ()


def sub_task_index(contact: int, phase: str, count: int) -> int:
    """Which of ``count`` sub-tasks a key pose serves, by the ordinal of its gripper transition.

    Each sub-task takes two transitions, and leaving is part of it.
    """
    own = contact - 1 if phase == "retreat" else contact
    return min(max(own, 0) // TRANSITIONS_PER_SUB_TASK, count - 1)


def parts(entry: MemoryEntry) -> tuple[MemoryEntry, ...]:
    """One entry for every sub-task of an entry that has several; the entry itself where it has one.

    A part holds its own key poses, and the objects that its sub-task names. A sub-task whose contacts are
    relative to other objects is no part, because nothing would look for these.
    """
    sub_tasks = entry.key.sub_tasks
    if len(sub_tasks) == 1 or sub_tasks[0].words:
        return (entry,)  # no words say what each part of an instruction is that cannot be read
    found = (_part(entry, i) for i in range(len(sub_tasks)))
    return tuple(part for part in found if part is not None)


def _part(entry: MemoryEntry, number: int) -> MemoryEntry | None:
    sub_task = entry.key.sub_tasks[number]
    kept = tuple(
        replace(pose, sub_task=0)
        for pose in entry.key_poses
        if pose.sub_task == number
        and (set(pose.anchor.objects) <= set(sub_task.objects) or pose.phase in CONTACT_PHASES)
    )
    contacts = [pose for pose in kept if pose.phase in CONTACT_PHASES]
    if not contacts or any(not set(pose.anchor.objects) <= set(sub_task.objects) for pose in contacts):
        return None
    return replace(
        entry,
        key=RetrievalKey((sub_task,), tuple(pose.phase for pose in kept)),
        language=phrase(sub_task),
        key_poses=kept,
        object_poses={name: T for name, T in entry.object_poses.items() if name in sub_task.objects},
        outcomes=tuple(replace(one, sub_task=0) for one in entry.outcomes if one.sub_task == number),
    )


def plan_parts(
    instruction: str,
    asked: tuple[SubTask, ...],
    entries: Sequence[MemoryEntry],
    names: NameSimilarity = TABLE_NAMES,
    looks: Looks = UNKNOWN_LOOKS,
) -> tuple[tuple[Candidate, ...], ...]:
    """What an instruction can be carried out by: for each part, in order, the entries that are about it.

    An entry that was demonstrated as a whole wins; then it is one part. Else the parts are the longest runs
    of sub-tasks that were demonstrated together, a single one also as a part of something else.

    Args:
        instruction: What is asked.
        asked: Its sub-tasks, as :func:`read_instruction` reads it.
        entries: The memory.
        names: Says which names mean the same thing.
        looks: What is known of the objects, to put one where another was shown.

    Raises:
        InstructionError: There is no memory of the instruction or of one of its sub-tasks; the error
            says why it could not be read or names the sub-task, and lists what the memory knows.
    """
    if asked[0].words:
        return _plan_by_words(instruction, asked, entries, names, looks)
    entries = near(asked, entries, partial(semantic_score, names=names))
    chain: list[tuple[Candidate, ...]] = []
    left = asked
    while left:
        said = instruction if len(asked) == 1 else phrase(left[0])
        try:
            found = _longest_run(left, said, entries, names, looks)
        except InstructionError as error:
            if len(asked) == 1:
                raise
            raise InstructionError(
                f"{said!r} is a part of the instruction {instruction!r} that cannot be done: {error}"
            ) from error
        done = [sub_task for part in chain for sub_task in _likeliest(part).entry.key.sub_tasks]
        needed = _condition(found, done, names) or _closed_before(found, done, names.lexicon)
        if needed is not None:
            try:
                chain.append(_longest_run((needed,), phrase(needed), entries, names, looks))
            except InstructionError as error:
                why = f"{said!r} cannot be done unless it comes after {phrase(needed)!r}"
                raise InstructionError(f"{why}: {error}") from error
        chain.append(found)
        left = left[len(found[0].asked) :]
    return tuple(chain)


def _condition(found: Sequence[Candidate], done: Sequence[SubTask], names: NameSimilarity) -> SubTask | None:
    """What has to be done before a part that nobody asked for, as all demonstrations of that did it.

    Before something goes into a drawer, that is opened.

    Args:
        found: What the part can be carried out by.
        done: The sub-tasks that are carried out before it, in order.
        names: Says which names mean the same thing.

    Raises:
        InstructionError: The demonstrations did different things before it.
    """
    before = [_done_before(one) for one in found]
    each = [one for one in before if one is not None]
    if len(each) < len(before) or any(_is_done(one, done, names.lexicon) for one in each):
        return None
    needed = each[found.index(_likeliest(found))]
    for other in each:
        # One of the two perhaps said with fewer words.
        alike = max(semantic_score((a,), (b,), names) for a, b in ((needed, other), (other, needed)))
        if alike < MIN_SEMANTIC:
            raise InstructionError(
                f"what comes before {phrase(found[0].asked[0])!r}? Demonstrations do different things before "
                f"it: {phrase(needed)!r} and {phrase(other)!r}; say one of these first"
            )
    return needed


def _done_before(one: Candidate) -> SubTask | None:
    """What the demonstration of a candidate did last with the place where it puts something."""
    put, shown = one.entry.key.sub_tasks[0], one.sources[-1].key.sub_tasks
    own = next((i for i, other in enumerate(shown) if _place(other) == _place(put)), 0)
    there = [other for other in shown[:own] if _place(put) == (other.target, other.part)]
    # What is put on a stove does not need that it was turned on; what goes into a microwave, that it is open.
    is_needed = bool(there) and (put.part or (put.relation == "in" and there[-1].operation == "open"))
    return there[-1] if is_needed else None


def _closed_before(found: Sequence[Candidate], done: Sequence[SubTask], lexicon: Lexicon) -> SubTask | None:
    """The opening of what a part puts something into, where that is closed before; arguments as above."""
    put = _likeliest(found).entry.key.sub_tasks[0]
    opening = SubTask("open", put.landmark, put.part, target_where=put.landmark_where)
    is_closed = _is_done(replace(opening, operation="close"), done, lexicon)
    return opening if put.relation == "in" and is_closed else None


def _is_done(needed: SubTask, done: Sequence[SubTask], lexicon: Lexicon) -> bool:
    """Whether it is the last that is done with its target: a drawer that is closed again is not open."""
    own = (
        one.operation
        for one in reversed(done)
        if same_meaning((replace(one, operation=needed.operation),), (needed,), lexicon)
    )
    return next(own, "") == needed.operation


def _likeliest(part: Sequence[Candidate]) -> Candidate:
    return max(part, key=lambda one: one.semantic)


def _place(sub_task: SubTask) -> tuple[str, str]:
    return sub_task.landmark, sub_task.part


def _plan_by_words(
    instruction: str,
    asked: tuple[SubTask, ...],
    entries: Sequence[MemoryEntry],
    names: NameSimilarity,
    looks: Looks,
) -> tuple[tuple[Candidate, ...], ...]:
    """Likewise where the grammar cannot read: as a whole, else step by step."""
    try:
        # By their words things are not told from others of their name, so what is asked is what was shown.
        found = candidates_for(asked, instruction, entries, names)
        return (tuple(Candidate(one, score, (one,), one.key.sub_tasks) for one, score in found),)
    except InstructionError as error:
        steps = split_steps(instruction, names.lexicon)
        with suppress(InstructionError):
            chain: list[tuple[Candidate, ...]] = []
            for one in steps:
                chain += plan_parts(one, read_instruction(one, entries, names), entries, names, looks)
            if chain:
                return tuple(chain)
        why = why_unread(instruction, entries, names)
        raise InstructionError(f"{why}; and {error}" if why else str(error)) from error


def _longest_run(
    asked: Sequence[SubTask], said: str, entries: Sequence[MemoryEntry], names: NameSimilarity, looks: Looks
) -> tuple[Candidate, ...]:
    """Candidates for the first sub-tasks, for as many as were demonstrated together.

    Where not even the first one was, it is put together.

    Raises:
        InstructionError: There are none for the first one, which is called as ``said``, or entries about
            different things fit it as well.
    """
    for n_sub_tasks in range(len(asked), 0, -1):
        run = tuple(asked[:n_sub_tasks])
        with suppress(InstructionError):
            found = candidates_for(run, said, entries, names)
            return tuple(Candidate(one, score, (one,), _as_done(run, one, names)) for one, score in found)
    sources = [(part, entry) for entry in entries for part in parts(entry)]
    source_of = {id(part): entry for part, entry in sources}
    try:
        found = candidates_for(asked[:1], said, [part for part, _ in sources], names)
    except InstructionError as error:
        return _put_together(asked[0], sources, names, looks, error)
    return tuple(Candidate(one, score, (source_of[id(one)],), tuple(asked[:1])) for one, score in found)


def _as_done(asked: tuple[SubTask, ...], entry: MemoryEntry, names: NameSimilarity) -> tuple[SubTask, ...]:
    """What is asked, in the order in which an entry does it, which may be another than it is said in."""
    if len(asked) == 1:
        return asked
    left, ordered = list(asked), list[SubTask]()
    for known in entry.key.sub_tasks:
        scores = [semantic_score((one,), (known,), names) for one in left]
        ordered.append(left.pop(scores.index(max(scores))))
    return tuple(ordered)


def _put_together(
    asked: SubTask,
    parts: Sequence[tuple[MemoryEntry, MemoryEntry]],
    names: NameSimilarity,
    looks: Looks,
    unknown: InstructionError,
) -> tuple[Candidate, ...]:
    """Candidates for a sub-task that no entry is about, or the error that says so."""
    known = {part.key.sub_tasks for part, _ in parts}
    among = AmongKnown(names, {name for key in known for sub_task in key for name in sub_task.objects})
    if any(semantic_score((asked,), key, among) >= MIN_SEMANTIC for key in known):
        raise unknown  # several are, and which one is meant is open

    def score(one: SubTask, other: SubTask) -> float:
        return semantic_score((one,), (other,), among)

    try:
        found = combinations(asked, parts, score, looks, names.lexicon)
    except InstructionError as error:
        raise InstructionError(f"{error}, and {unknown}") from error
    if not found:
        raise unknown
    return tuple(Candidate(one.entry, one.semantic, (one.grasp, one.place), (asked,)) for one in found)
