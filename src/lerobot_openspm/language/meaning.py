"""How alike two readings are: the semantic score of retrieval, and the form in which wordings are one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

from lerobot_openspm.language.lexicon import ENGLISH, Lexicon
from lerobot_openspm.language.names import TABLE_NAMES, NameSimilarity
from lerobot_openspm.language.own_words import words_similarity
from lerobot_openspm.types import Reference, SubTask

# What is lost where the part is not said, or another one; where the thing would end elsewhere.
PART_UNSAID, OTHER_PART, OTHER_RELATION = 0.9, 0.5, 0.6
# Asked to put somewhere what was shown to be pushed there: the result is the same.
PUSHED_THERE = 0.85
# Which of several is meant is found in the scene, so it matters less than what is meant.
WHERE_UNSAID, OTHER_WHERE = 0.93, 0.9
# The same things in another order, where the order does not matter.
OTHER_ORDER = 0.98
# Above this number of sub-tasks all orders are not tried.
MAX_REORDERED = 4


def canonical(sub_task: SubTask, lex: Lexicon = ENGLISH) -> SubTask:
    """The form in which all wordings of one sub-task are equal."""
    part = "" if sub_task.part in lex.silent_parts else sub_task.part
    landmark = lex.canonical(sub_task.landmark) if sub_task.landmark else ""
    return replace(
        sub_task,
        target=lex.canonical(sub_task.target),
        part=part,
        relation=_canonical_relation(lex, sub_task.relation, landmark, part),
        landmark=landmark,
        target_where=_canonical_where(lex, sub_task.target_where),
        landmark_where=_canonical_where(lex, sub_task.landmark_where),
    )


def same_meaning(one: Sequence[SubTask], other: Sequence[SubTask], lex: Lexicon = ENGLISH) -> bool:
    """Whether two readings are equal but for other names of the same things and an order that matters not."""
    a, b = [canonical(s, lex) for s in one], [canonical(s, lex) for s in other]
    return a == b or (_may_be_reordered(lex, a) and sorted(a, key=repr) == sorted(b, key=repr))


def means_the_same(one: Sequence[SubTask], other: Sequence[SubTask], lex: Lexicon = ENGLISH) -> bool:
    """Whether two keys are about things of the same names, one perhaps not saying which of several is meant.

    Unlike :func:`same_meaning` it takes two names for two things, even if they can mean the same.
    """
    if not one or not other or len(one) != len(other) or one[0].words or other[0].words:
        return bool(one and other) and one[0].words == other[0].words != ""
    a, b = _without_wheres(lex, one), _without_wheres(lex, other)
    orders = [(a, b)]
    if _may_be_reordered(lex, one) and _may_be_reordered(lex, other):
        orders.append((sorted(a, key=repr), sorted(b, key=repr)))
    return any(
        [x[0] for x in xs] == [y[0] for y in ys] and all(map(_no_other_where, xs, ys)) for xs, ys in orders
    )


_Wheres = tuple[Reference | None, Reference | None]


def _without_wheres(lex: Lexicon, sub_tasks: Sequence[SubTask]) -> list[tuple[SubTask, _Wheres]]:
    """Sub-tasks in one form but with the names they have, apart from what tells which of several is meant."""
    found: list[tuple[SubTask, _Wheres]] = []
    for told in sub_tasks:
        form = canonical(told, lex)
        named = replace(form, target=told.target, landmark=told.landmark)
        wheres = form.target_where, form.landmark_where
        found.append((replace(named, target_where=None, landmark_where=None), wheres))
    return found


def _no_other_where(one: tuple[SubTask, _Wheres], other: tuple[SubTask, _Wheres]) -> bool:
    return all(a == b or a is None or b is None for a, b in zip(one[1], other[1], strict=True))


def _canonical_relation(lex: Lexicon, relation: str, landmark: str, part: str) -> str:
    """The relation that the landmark allows: "to the basket" and "on the basket" are "in" it."""
    if relation not in ("at", "on", "in") or not landmark:
        return relation
    holder = part.split()[-1] if part else landmark.split()[-1]
    if holder in lex.hollow:
        return "in"
    return "on" if relation == "at" or holder in lex.open_supports else relation


def _canonical_where(lex: Lexicon, where: Reference | None) -> Reference | None:
    if where is None or (where.relation == "on" and set(where.landmarks) <= lex.surfaces and where.landmarks):
        return None  # everything stands on the table
    return Reference(where.relation, tuple(sorted(lex.canonical(name) for name in where.landmarks)))


def semantic_score(
    asked: Sequence[SubTask], known: Sequence[SubTask], names: NameSimilarity = TABLE_NAMES
) -> float:
    """``S_sem`` in 0..1: how far task elements agree, sub-task by sub-task; the least of them counts.

    Args:
        asked: What an instruction says.
        known: What an entry is about.
        names: Says which names mean the same thing.
    """
    if asked and known and asked[0].words and known[0].words:
        # How many things the hand took shows in the demonstrations, and is not in the words.
        return words_similarity(asked[0].words, known[0].words, names)
    if len(asked) != len(known) or not asked:
        return 0.0
    best = min([_sub_task_score(a, k, names) for a, k in zip(asked, known, strict=True)])
    if best < OTHER_ORDER and 1 < len(asked) <= MAX_REORDERED and _may_be_reordered(names.lexicon, asked):
        scores = [[_sub_task_score(a, k, names) for k in known] for a in asked]
        for order in permutations(scores):
            best = max(best, OTHER_ORDER * min([row[i] for i, row in enumerate(order)]))
    return best


def _may_be_reordered(lex: Lexicon, sub_tasks: Sequence[SubTask]) -> bool:
    """Whether the order does not matter: things are put somewhere, none of them on one that is put itself."""
    targets = {lex.canonical(s.target) for s in sub_tasks}
    return all(s.operation == "put" and lex.canonical(s.landmark) not in targets for s in sub_tasks)


def _sub_task_score(asked: SubTask, known: SubTask, names: NameSimilarity) -> float:
    if asked.words or known.words:
        return 0.0  # one is read by the grammar, the other is not
    score = names.similarity(asked.target, known.target)
    if asked.landmark or known.landmark:
        score *= names.similarity(asked.landmark, known.landmark)
    if score == 0.0:
        return 0.0
    a, k = canonical(asked, names.lexicon), canonical(known, names.lexicon)
    if a.relation != k.relation:
        score *= OTHER_RELATION
    if a.operation != k.operation:
        beside = a.relation == k.relation and a.relation not in ("", "on", "in")
        score *= PUSHED_THERE if beside and (a.operation, k.operation) == ("put", "push") else 0.0
    score *= _parts_agree(a.part, k.part)
    return (
        score
        * _wheres_agree(a.target_where, k.target_where)
        * _wheres_agree(a.landmark_where, k.landmark_where)
    )


def _parts_agree(asked: str, known: str) -> float:
    if asked == known:
        return 1.0
    if not asked or (known and known.split()[-1] == asked):
        return PART_UNSAID  # "the drawer" for "the top drawer"
    return OTHER_PART


def _wheres_agree(asked: Reference | None, known: Reference | None) -> float:
    if asked == known:
        return 1.0
    return WHERE_UNSAID if asked is None or known is None else OTHER_WHERE
