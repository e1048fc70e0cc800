"""What could not be learned: objects, whole instructions, or something from some demonstrations."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from lerobot_openspm.memory.entry import MemoryEntry

# The longest name and reason that are kept, in characters, and how many records.
MAX_CHARS, MAX_RECORDS = 1000, 1000
NEXT_STEP = "docs/mining.md says what helps, by the reason"
# An object that the hand touches; demonstrations of one that is known, which do not show it; an instruction.
type What = Literal["object", "demonstrations", "instruction"]


@dataclass(frozen=True)
class NotLearned:
    """One thing that mining could not learn, up to :data:`MAX_CHARS` characters of each text.

    Attributes:
        what: What could not be learned.
        name: The object's name, or the instruction.
        demonstrations: In how many demonstrations the object is handled, how many are left out, or how many
            the instruction has.
        reason: Why it could not be learned.
    """

    what: What
    name: str
    demonstrations: int
    reason: str

    def __str__(self) -> str:
        """It in a sentence, with what to do about it."""
        count = f"{self.demonstrations} demonstration{'s' * (self.demonstrations != 1)}"
        if self.what == "instruction":
            return f"{self.name!r} is not learned: none of its {count} is kept, because {self.reason}"
        if self.what == "demonstrations":
            return f"{count} of {self.name!r} left out: {self.reason}; {NEXT_STEP}"
        return f"{self.name!r} is handled in {count} and could not be learned: {self.reason}; {NEXT_STEP}"


def not_learned(what: What, name: str, demonstrations: int, reason: str) -> NotLearned:
    """A record of texts of any length, on one line each."""
    return NotLearned(what, _on_one_line(name), demonstrations, _on_one_line(reason))


def _on_one_line(text: str) -> str:
    words = " ".join(text.split())[:MAX_CHARS]
    return "".join(letter for letter in words if letter.isprintable()).strip() or "?"


def still_not_learned(
    older: Sequence[NotLearned],
    newer: Sequence[NotLearned],
    objects: Collection[str],
    entries: Sequence[MemoryEntry],
) -> tuple[NotLearned, ...]:
    """What is left of two memories' records once their entries are together; the newer one's word counts.

    Args:
        older: Records of the memory that is added to.
        newer: Records of what is added.
        objects: Names of all objects that are known by now.
        entries: The newer entries.
    """
    told = {(one.what, one.name): one for one in (*older, *newer)}
    taught = {_on_one_line(entry.language) for entry in entries}
    found_now = {("object", name) for name in objects} | {("instruction", name) for name in taught}
    again = {(one.what, one.name) for one in newer}
    kept = [one for key, one in told.items() if key in again or key not in found_now]
    return tuple(kept[-MAX_RECORDS:])
