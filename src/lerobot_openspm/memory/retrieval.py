"""Retrieval: what is meant decides first; of entries that mean the same the paper's score chooses one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.instruction import parse_instruction, read_task
from lerobot_openspm.language.meaning import means_the_same, semantic_score
from lerobot_openspm.language.names import TABLE_NAMES, AmongKnown, NameSimilarity
from lerobot_openspm.language.own_words import normal_words, unread
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.indexed_entries import known_names, near
from lerobot_openspm.types import SubTask

# Below this semantic score an entry is about something else.
MIN_SEMANTIC = 0.75
# Entries about different things whose scores lie this close together leave open which is meant.
MARGIN = 0.05
# The paper's lambda_s, lambda_g and lambda_r. Only entries that mean the same are compared, so scene and
# quality weigh alike; what is meant weighs most.
LAMBDAS = (1.0, 0.5, 0.5)
# An error names at most this many known instructions.
MAX_NAMED = 20


@dataclass(frozen=True)
class Scored:
    """An entry with the three terms of its score."""

    entry: MemoryEntry
    semantic: float
    geometric: float
    quality: float
    total: float


def read_instruction(
    instruction: str, entries: Sequence[MemoryEntry], names: NameSimilarity = TABLE_NAMES
) -> tuple[SubTask, ...]:
    """What an instruction asks for, read by someone who knows the memory.

    It is read by the grammar, with the names of the memory's things. If no entry is about exactly that, an
    instruction in the words of a demonstration means what that showed, and any other is also compared by its
    words with the demonstrations that the grammar cannot read.

    Args:
        instruction: What is asked.
        entries: The memory.
        names: Says which names mean the same thing.

    Raises:
        InstructionError: There is not a word in it.
    """
    known = known_names(entries)
    score = partial(semantic_score, names=AmongKnown(names, known))
    own = (unread(instruction, names.lexicon),)
    read, best = read_task(instruction, known, names.lexicon), MIN_SEMANTIC
    for asked in dict.fromkeys((read, own)):
        close = near(asked, entries, score)
        scores = {key: score(asked, key) for key in {entry.key.sub_tasks for entry in close}}
        most = max(scores.values(), default=0.0)
        if most == 1.0:
            return asked
        for entry in close:
            if normal_words(entry.language, names.lexicon) == own[0].words:
                return own if entry.key.sub_tasks[0].words else entry.key.sub_tasks
        if most > best:
            read, best = asked, most
    return read


def why_unread(instruction: str, entries: Sequence[MemoryEntry], names: NameSimilarity) -> str:
    """Why the grammar cannot read an instruction; "" where it can."""
    try:
        parse_instruction(instruction, known_names(entries), names.lexicon)
    except InstructionError as error:
        return str(error)
    return ""


def candidates_for(
    sub_tasks: Sequence[SubTask],
    instruction: str,
    entries: Sequence[MemoryEntry],
    names: NameSimilarity = TABLE_NAMES,
) -> list[tuple[MemoryEntry, float]]:
    """Entries that are about some sub-tasks, with their ``S_sem``.

    Args:
        sub_tasks: What is asked.
        instruction: How errors call it.
        entries: The memory.
        names: Says which names mean the same thing.

    Raises:
        InstructionError: No entry is about them, or entries about different things fit them as well. The
            error names the instructions that the memory knows, or those that may be meant.
    """
    entries = near(sub_tasks, entries, partial(semantic_score, names=names))
    # Demonstrations of one task share their key, so there are far fewer keys than entries.
    keys = {entry.key.sub_tasks for entry in entries}
    names = AmongKnown(names, {name for key in keys for sub_task in key for name in sub_task.objects})
    scores = {key: semantic_score(sub_tasks, key, names) for key in keys}
    best = max(scores, key=lambda key: scores[key], default=())
    if scores.get(best, 0.0) < MIN_SEMANTIC:
        raise InstructionError(_unknown(instruction, entries, scores))
    # What may mean the same as the best, one of the two perhaps said with fewer words.
    alike = {
        key
        for key, score in scores.items()
        if score >= MIN_SEMANTIC
        and max(semantic_score(best, key, names), semantic_score(key, best, names)) >= MIN_SEMANTIC
    }
    least = max(scores[best] - MARGIN, MIN_SEMANTIC)
    rivals = {key for key, score in scores.items() if score >= least} - alike
    if rivals and scores[best] < 1.0:  # else just that is known
        meant = sorted({entry.language for entry in entries if entry.key.sub_tasks in {best, *rivals}})
        raise InstructionError(
            f"the instruction {instruction!r} may mean different things; did you mean "
            f"{' or '.join(repr(language) for language in _shortened(meant))}? Say it in those words"
        )
    return [(entry, scores[entry.key.sub_tasks]) for entry in entries if entry.key.sub_tasks in alike]


def _unknown(
    instruction: str, entries: Sequence[MemoryEntry], scores: Mapping[tuple[SubTask, ...], float]
) -> str:
    known = "; ".join(_shortened(sorted({entry.language for entry in entries}))) or "nothing yet"
    nearest = max(entries, key=lambda entry: scores[entry.key.sub_tasks], default=None)
    is_near = nearest is not None and scores[nearest.key.sub_tasks] > 0
    did_you_mean = f"; did you mean {nearest.language!r}?" if nearest is not None and is_near else ""
    return (
        f"the memory holds no entry for the instruction {instruction!r}{did_you_mean or ';'} it knows: "
        f"{known}. Record demonstrations of it and train again, or use one of these instructions"
    )


def _shortened(languages: list[str]) -> list[str]:
    more = len(languages) - MAX_NAMED
    return languages if more <= 0 else [*languages[:MAX_NAMED], f"and {more} more"]


def retrieve(
    candidates: Sequence[tuple[MemoryEntry, float]],
    geometric: Callable[[MemoryEntry], float],
    names: NameSimilarity = TABLE_NAMES,
) -> list[Scored]:
    """Rank entries, best first: those that are meant, of these the usable ones, then by the paper's score.

    The score is ``lambda_s S_sem + lambda_g S_geo + lambda_r r``. Meant is what has the highest ``S_sem``,
    and what means the same: no scene makes the mug's entry act where the cup is asked for and known. Where
    none of these is usable, one of them still comes first, so that its objects are looked for.

    Args:
        candidates: Entries with their semantic score.
        geometric: ``S_geo`` in 0..1 of an entry in the present scene; 0 if it cannot be executed there,
            because an object was not found or its key poses, carried over, fail the checks.
        names: Says which names mean the same thing.
    """
    lambda_s, lambda_g, lambda_r = LAMBDAS
    ranked: list[Scored] = []
    for entry, semantic in candidates:
        geometry = geometric(entry)
        total = lambda_s * semantic + lambda_g * geometry + lambda_r * entry.quality
        ranked.append(Scored(entry, semantic, geometry, entry.quality, total))
    most = max((scored.semantic for scored in ranked), default=0.0)
    meant = {scored.entry.key.sub_tasks for scored in ranked if scored.semantic == most}
    is_meant = {
        key: any(means_the_same(one, key, names.lexicon) for one in meant)
        for key in {scored.entry.key.sub_tasks for scored in ranked}
    }
    return sorted(
        ranked,
        key=lambda scored: (
            not is_meant[scored.entry.key.sub_tasks], scored.geometric == 0.0, -scored.total
        ),
    )  # fmt: skip
