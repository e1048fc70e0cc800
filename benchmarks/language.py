"""How well instructions are understood: read, found again, told from others, and refused.

python -m benchmarks.language
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.results import run, write
from benchmarks.taught_words import acted_entries, teach_each
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.language.meaning import same_meaning
from lerobot_openspm.memory.compose import plan_parts
from lerobot_openspm.memory.entry import MemoryEntry, RetrievalKey
from lerobot_openspm.memory.retrieval import read_instruction
from lerobot_openspm.types import Reference, SubTask

INSTRUCTIONS = Path(__file__).with_name("instructions")
# The instructions and their elements, which were checked by reading every line.
KNOWN, PARAPHRASES, OUT_OF_DOMAIN = "known.json", "paraphrases.json", "out_of_domain.json"
# Everyday instructions, each with a light rewording; half of them the grammar cannot read.
EVERYDAY = "everyday.json"
HELD_OUT = "held_out"
SEED = 0  # of the drawn demonstrations
# A line of paraphrases.json ("paraphrase", "of", "split") or of out_of_domain.json ("instruction", ...).
Row = dict[str, str]
# The suites with demonstrations or their keys, over which the right entry is to come first.
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "tabletop")


@dataclass
class LanguageConfig:
    """Measure how instructions are read. Needs no checkpoint and no simulator."""

    failures: bool = False  # whether to print what failed


@dataclass(frozen=True)
class Known:
    """An instruction of LIBERO or the tabletop.

    Attributes:
        instruction: Its words.
        tasks: ``suite/task`` of the tasks that are told in these words.
        names: Of the tasks whose name says it in these words, which differ from those they are told in.
        elements: What it means.
    """

    instruction: str
    tasks: tuple[str, ...]
    names: tuple[str, ...]
    elements: tuple[SubTask, ...]

    @property
    def suites(self) -> frozenset[str]:
        """The suites it belongs to."""
        return frozenset(task.split("/")[0] for task in (*self.tasks, *self.names))


@cache
def known_instructions() -> tuple[Known, ...]:
    """Every instruction of LIBERO's 130 tasks and the tabletop's ten, with its elements."""
    rows = json.loads((INSTRUCTIONS / KNOWN).read_text())
    return tuple(
        Known(
            row["instruction"],
            tuple(row.get("tasks", ())),
            tuple(row.get("names", ())),
            tuple(_sub_task(e) for e in row["elements"]),
        )
        for row in rows
    )


def _sub_task(fields: dict[str, Any]) -> SubTask:
    def reference(key: str) -> Reference | None:
        where = fields.get(key)
        return Reference(where["relation"], tuple(where.get("landmarks", ()))) if where else None

    words = {key: value for key, value in fields.items() if not key.endswith("_where")}
    return SubTask(
        **words, target_where=reference("target_where"), landmark_where=reference("landmark_where")
    )


def known_entries(suites: Sequence[str] | None = None) -> list[MemoryEntry]:
    """A memory of keys alone: one entry for each wording of the tasks of some suites, or of all."""
    return [
        MemoryEntry(RetrievalKey(known.elements, ()), known.instruction, (), 1.0, 1, "instructions")
        for known in known_instructions()
        if suites is None or known.suites & set(suites)
    ]


def read_rows(name: str, folder: Path = INSTRUCTIONS) -> list[Row]:
    """The paraphrases and the instructions out of domain, each with its "split", or the everyday ones."""
    return json.loads((folder / name).read_text())


def is_parsed(row: Row) -> bool:
    """Whether a paraphrase means the same as its original."""
    original = _elements()[row["of"]]
    try:
        return same_meaning(parse_instruction(row["paraphrase"]), original)
    except InstructionError:
        return False


@cache
def _elements() -> dict[str, tuple[SubTask, ...]]:
    return {known.instruction: known.elements for known in known_instructions()}


def is_refused(row: Row, entries: Sequence[MemoryEntry]) -> bool:
    """Whether an instruction is not read, or nothing in the memory is about it."""
    try:
        plan_parts(row["instruction"], read_instruction(row["instruction"], entries), entries)
    except InstructionError:
        return True
    return False


def is_first(row: Row, entries: Sequence[MemoryEntry]) -> bool:
    """Whether the best entries for a paraphrase are all of its original's meaning."""
    try:
        found = plan_parts(row["paraphrase"], read_instruction(row["paraphrase"], entries), entries)
    except InstructionError:
        return False
    if len(found) != 1:
        return False  # of the parts of other tasks
    best, original = max(one.semantic for one in found[0]), _elements()[row["of"]]
    return all(same_meaning(c.entry.key.sub_tasks, original) for c in found[0] if c.semantic == best)


def main(config: LanguageConfig) -> dict[str, Any]:
    """Measure, write and return the result."""
    result = measure()
    failures = result.pop("failures")
    written = write("language", result)
    return {**written, "failures": failures} if config.failures else written


def measure(folder: Path = INSTRUCTIONS) -> dict[str, Any]:
    """Read everything; rates of paraphrases are those of the held-out half, where there is one."""
    failures: dict[str, list[str]] = {}
    names = {row["split"] for name in (PARAPHRASES, OUT_OF_DOMAIN) for row in read_rows(name, folder)}
    splits = {split: _measure_split(split, folder, failures) for split in sorted(names)}
    split = HELD_OUT if HELD_OUT in splits else next(iter(splits))
    of_libero = [known for known in known_instructions() if known.suites - {"tabletop"}]
    read = [known for known in of_libero if _is_read(known)]
    of_split = [row for row in read_rows(PARAPHRASES, folder) if row["split"] == split]
    return {
        "seed": SEED,
        **_measure_acting(read_rows(EVERYDAY, folder), of_split, failures),
        **splits[split],
        "split": split,
        "libero_parsed": _wordings(read) / _wordings(of_libero),
        "n_libero": _wordings(of_libero),
        "splits": splits,
        "failures": failures,
    }


def _measure_acting(
    everyday: Sequence[Row],
    paraphrases: Sequence[Row],
    failures: dict[str, list[str]],
) -> dict[str, Any]:
    """What the policy acts by after one drawn demonstration each, with everything but the words against it.

    `acted_entry_right` is over the everyday instructions in both wordings, those of the suites with
    demonstrations in their own words, and the paraphrases of these that are not refused.
    """
    told = [row["instruction"] for row in everyday]
    shown = [entry.language for entry in known_entries(SUITES)]
    to_find = [(row["paraphrase"], row["of"]) for row in paraphrases if row["of"] in shown]
    asked = [(row[key], row["instruction"]) for row in everyday for key in ("instruction", "reworded")]
    rights = _rights(asked, told, _is_told_as)
    rights |= _rights([*((one, one) for one in shown), *to_find], shown, _is_about)
    refused = [said for said, _ in to_find if rights[said] is None]
    acted = {said: is_right for said, is_right in rights.items() if said not in refused}
    unlearned = [
        r["instruction"] for r in everyday if not (rights[r["instruction"]] and rights[r["reworded"]])
    ]
    failures["acted_entry_right"] = [said for said, is_right in acted.items() if not is_right]
    failures["any_wording_learned"] = unlearned
    return {
        "acted_entry_right": sum(map(bool, acted.values())) / len(acted),
        "any_wording_learned": 1 - len(unlearned) / len(told) if told else None,
        "n_acted": len(acted),
        "n_refused": len(refused),
        "n_wordings": len(told),
    }


def _rights(
    asked: Sequence[tuple[str, str]],
    taught: Sequence[str],
    is_meant: Callable[[str, MemoryEntry], bool],
) -> dict[str, bool | None]:
    """For every instruction, given with its meaning, whether just the right entry acts; None if none does."""
    entries = _taught(tuple(taught))
    acted = {said: (acted_entries(said, entries, partial(is_meant, of)), of) for said, of in asked}
    return {
        said: (len(found) == 1 and is_meant(of, found[0])) if found else None
        for said, (found, of) in acted.items()
    }


@cache
def _taught(instructions: tuple[str, ...]) -> list[MemoryEntry]:
    """One memory of all instructions, the same whenever it is asked for."""
    return teach_each(instructions, np.random.default_rng(SEED))


def _is_told_as(instruction: str, entry: MemoryEntry) -> bool:
    return entry.language == instruction


def _is_about(instruction: str, entry: MemoryEntry) -> bool:
    """Whether an entry means what a known instruction means."""
    return same_meaning(entry.key.sub_tasks, _elements()[instruction])


def _wordings(known: Sequence[Known]) -> int:
    """Wordings of LIBERO's tasks: what each is told in, and what its name says where that is different."""
    return sum(not task.startswith("tabletop") for one in known for task in (*one.tasks, *one.names))


def _is_read(known: Known) -> bool:
    try:
        return parse_instruction(known.instruction) == known.elements
    except InstructionError:
        return False


def _measure_split(split: str, folder: Path, failures: dict[str, list[str]]) -> dict[str, Any]:
    paraphrases = [row for row in read_rows(PARAPHRASES, folder) if row["split"] == split]
    strangers = [row for row in read_rows(OUT_OF_DOMAIN, folder) if row["split"] == split]
    everything, demonstrated = known_entries(), known_entries(SUITES)
    of_demonstrated = {entry.language for entry in demonstrated}
    to_find = [row for row in paraphrases if row["of"] in of_demonstrated]

    def rate(what: str, rows: list[Row], passes: Callable[[Row], bool]) -> float | None:
        failed = [row for row in rows if not passes(row)]
        failures[f"{split}_{what}"] = [row.get("paraphrase") or row["instruction"] for row in failed]
        return 1 - len(failed) / len(rows) if rows else None

    return {
        "paraphrases_parsed": rate("paraphrases_parsed", paraphrases, is_parsed),
        "out_of_domain_refused": rate(
            "out_of_domain_refused", strangers, lambda row: is_refused(row, everything)
        ),
        "retrieved_first": rate("retrieved_first", to_find, lambda row: is_first(row, demonstrated)),
        "n": len(paraphrases),
        "retrieved_first_of_all": rate(
            "retrieved_first_of_all", paraphrases, lambda row: is_first(row, everything)
        ),
        "n_out_of_domain": len(strangers),
        "n_retrieved": len(to_find),
    }


if __name__ == "__main__":
    run(LanguageConfig, main)
