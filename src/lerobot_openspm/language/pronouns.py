"""What pronouns and half-said names stand for: from what an instruction said before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.clauses import Said
from lerobot_openspm.language.lexicon import Lexicon
from lerobot_openspm.language.phrases import Noun
from lerobot_openspm.types import SubTask

POINTING = ("it", "them", "there")


def is_there(said: Said) -> bool:
    """Whether it goes where was said before: "the bowl belongs on the stove, put it there"."""
    return said.landmark is not None and (said.relation, said.landmark.pronoun) == ("at", "there")


@dataclass(frozen=True)
class Resolver:
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
            if is_there(said) and self.before:
                relation = self.before[-1].relation or relation
        # What is put on a drawer stands on the cabinet.
        part = "" if relation == "on" and landmark.part.endswith("drawer") else landmark.part
        return tuple(
            SubTask(said.operation, t.name, t.part or part, relation, landmark.name, t.where, landmark.where)
            for t in targets
            for _ in range(t.count)
        )

    def _targets(self, noun: Noun, operation: str) -> list[Noun]:
        if noun.pronoun not in POINTING:
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
        if noun.pronoun not in POINTING:
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
