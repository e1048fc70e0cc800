"""A second reading, for sentences whose word order the grammar does not know: elements wherever they stand.

Every word must be explained: as a thing, an attribute, a cue of what is to be done or where, or one of a
closed list that say nothing. Then roles follow from what stands next to a name, not from the whole sentence.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.language.loose_fragments import Fragment, Phrase, read_fragments
from lerobot_openspm.language.loose_words import THINGS, read_elements, said_again
from lerobot_openspm.language.names import canonical_name
from lerobot_openspm.language.nouns import Noun
from lerobot_openspm.language.sense import MADE, OPENED, SWITCHED, is_said_again
from lerobot_openspm.language.sentences import MAX_CHARACTERS, is_question, refuse_what_asks_for_nothing
from lerobot_openspm.language.wording import plain_words
from lerobot_openspm.types import Reference, SubTask


def read_loosely(instruction: str, things: Collection[str] = THINGS) -> tuple[SubTask, ...]:
    """Read what is to be done from its elements.

    Args:
        instruction: In any order of words; it must be known to be no question, negation or condition.
        things: Names of the things that may be meant.

    Raises:
        InstructionError: A word is not known, nothing is asked for, or something is left open.
    """
    if len(instruction) > MAX_CHARACTERS:
        raise InstructionError("is too long")
    text = plain_words(instruction)
    refuse_what_asks_for_nothing(text)
    text = said_again(text)
    if any(is_question(tuple(s.split())) for s in text.split(" ; ") if s.strip()):
        raise InstructionError("is a question; say what to do")
    elements = read_elements(text, things)
    fragments = read_fragments(elements)
    is_polite = "please" in instruction.lower() or "kindly" in instruction.lower()
    if not is_polite and not any(f.is_wish for f in fragments):
        raise InstructionError("states something; say what to do")
    reader = _Reader()
    for fragment in fragments:
        reader.read(fragment)
    return reader.finish()


def _opened_first(steps: list[SubTask]) -> list[SubTask]:
    """The opening of a thing before what is put into it: "it goes in the drawer, so open that"."""
    for step in [s for s in steps if s.operation == "open"]:
        at = steps.index(step)
        into = [i for i, s in enumerate(steps[:at]) if (s.landmark, s.part) == (step.target, step.part)]
        if into and not any(s.operation == "close" for s in steps):
            steps.insert(into[0], steps.pop(at))
    return steps


def _elsewhere(target: Noun, relation: str, landmark: Noun) -> Noun:
    """A target that is not told by being already where it goes."""
    where = target.where
    is_there = where == Reference(relation.removesuffix(" of"), (landmark.name,)) and relation.endswith(" of")
    return replace(target, where=None) if is_there else target


class _Reader:
    """Makes steps of fragments; remembers what was named."""

    def __init__(self) -> None:
        self._steps: list[SubTask] = []
        self._named: list[Noun] = []
        self._waiting: list[Noun] = []  # targets that still go nowhere
        self._goal: tuple[str, Noun] | None = None  # where something goes that was not said yet
        self._about: list[Phrase] = []  # which one is meant, said before it is named
        self._listed: tuple[str, Noun] | None = None  # where things go that are listed after it
        self._pushes = False
        self._later: list[SubTask] = []

    def read(self, fragment: Fragment) -> None:
        """Read a fragment."""
        if fragment.marker == ";" and not any(n.pronoun for n in fragment.nouns) and not self._goal:
            self._waiting = self._waiting if not fragment.nouns else []
        start = len(self._steps)
        is_told = fragment.is_wish or not fragment.is_state or fragment.marker == "after"
        if fragment.operation in MADE and is_told:
            self._make(fragment)
        else:
            self._place(fragment, is_told and not fragment.is_seen)
        new, self._steps = self._steps[start:], self._steps[:start]
        if fragment.marker == "before" and not self._steps:
            self._later += new
        elif fragment.is_first:
            self._steps = [*new, *self._steps]
        elif fragment.marker == "after" and self._steps:
            self._steps = [*self._steps[:-1], *new, self._steps[-1]]
        else:
            self._steps += new

    def finish(self) -> tuple[SubTask, ...]:
        """The steps.

        Raises:
            InstructionError: Something is left open.
        """
        found: list[SubTask] = []
        for step in (*self._steps, *self._later):
            at = next((i for i, other in enumerate(found) if is_said_again(other, step)), None)
            if at is None or (found[at] == step and self._count(step)):
                found.append(step)
            elif step.operation == "push":
                found[at] = replace(found[at], operation="push")
        if not found or self._goal is not None or self._waiting:
            raise InstructionError("leaves open what is to be done to what")
        return tuple(_opened_first(found))

    def _count(self, step: SubTask) -> bool:
        return any(noun.count > 1 and noun.name == step.target for noun in self._named)

    def _make(self, fragment: Fragment) -> None:
        """Open, close or switch something."""
        things = [*fragment.nouns, *(n for p in fragment.phrases for n in p.nouns)]
        things = [self._resolve(n) for n in things if n.pronoun in ("", "one", "its")]
        self._named += things
        may_be = SWITCHED if fragment.operation.startswith("turn") else OPENED
        fits = [n for n in (things or reversed(self._named)) if canonical_name(n.name) in may_be]
        if not fits:
            raise InstructionError(f"names nothing to {fragment.operation}")
        target = fits[0]
        if v.kind(target.name) == "cabinet" and not target.part and things:
            target = next(
                (n for n in reversed(self._named) if n.part and v.kind(n.name) == "cabinet"), target
            )
        part = "" if target.part == "door" else target.part
        self._waiting = [n for n in self._waiting if n.name != target.name]
        where = target.where if target.where and not target.where.landmarks else None
        self._steps.append(SubTask(fragment.operation, target.name, part, target_where=where))

    def _place(self, fragment: Fragment, is_told: bool) -> None:
        """Put something somewhere, or remember what is said of it."""
        self._pushes |= fragment.operation == "push"
        targets = self._targets(fragment)
        phrases = list(fragment.phrases)
        if not targets and not any(p.nouns and not p.is_reference for p in phrases) and not fragment.is_wish:
            if self._waiting and phrases:
                self._waiting[-1] = self._which(self._waiting[-1], phrases)
            else:
                self._about += phrases
            self._named += [self._resolve(n) for p in phrases for n in p.nouns if not n.pronoun]
            return
        phrases, self._about = [*self._about, *phrases], []
        goal = self._pick_goal(phrases, fragment) if is_told else None
        after = phrases[phrases.index(goal) + 1 :] if goal else []
        about = [p for p in phrases if p is not goal and (p not in after or p.preposition.is_source)]
        if targets and about:
            targets[-1] = self._which(targets[-1], about)
        elif about and self._waiting:
            self._waiting[-1] = self._which(self._waiting[-1], about)
        elif goal is not None:
            self._about = about
        self._named += targets
        self._named += [self._resolve(n) for p in about for n in p.nouns if not n.pronoun]
        if goal is None:
            self._wait(fragment, targets, is_told)
        else:
            self._send(fragment, targets, goal, after)

    def _wait(self, fragment: Fragment, targets: list[Noun], is_told: bool) -> None:
        """Keep targets that go nowhere yet; put them where was said before."""
        if targets:
            self._waiting = targets if fragment.is_seen or fragment.operation else self._joined(targets)
            if fragment.is_state and not is_told and not fragment.phrases:
                self._waiting = []
        if fragment.operation == "push" and self._steps and targets == self._last_targets():
            self._steps[-1], self._waiting = replace(self._steps[-1], operation="push"), []
            self._pushes = False
        listed = self._listed if fragment.marker in (",", "and") and not fragment.operation else None
        if self._waiting and (goes := self._goal or listed):
            self._put(self._waiting, *goes)
            self._listed = goes

    def _send(self, fragment: Fragment, targets: list[Noun], goal: Phrase, after: Sequence[Phrase]) -> None:
        """Put targets at a goal, or keep the goal for what is named next."""
        self._listed = None
        landmark, relation = self._landmark(goal, targets)
        landmark = self._which(landmark, after) if after else landmark
        is_joined = fragment.marker in (",", "and", "") and not any(n.pronoun for n in fragment.nouns)
        if is_joined:
            targets = self._joined(targets)
        targets = [
            t
            for t in targets or self._waiting or self._last_targets()
            if (t.name, t.where) != (landmark.name, landmark.where)
        ]
        targets = [_elsewhere(t, relation, landmark) for t in targets]
        self._named.append(landmark)
        if targets:
            self._put(targets, relation, landmark)
            self._listed = (relation, landmark)
        else:
            self._goal = (relation, landmark)

    def _joined(self, targets: list[Noun]) -> list[Noun]:
        return [*(t for t in self._waiting if t not in targets), *targets]

    def _put(self, targets: Sequence[Noun], relation: str, landmark: Noun) -> None:
        operation = "push" if self._pushes else "put"
        part = "" if relation == "on" and landmark.part.endswith("drawer") else landmark.part
        for target in targets:
            step = SubTask(
                operation, target.name, part, relation, landmark.name, target.where, landmark.where
            )
            self._steps += [step] * target.count
        self._waiting, self._goal, self._pushes = [], None, False

    def _targets(self, fragment: Fragment) -> list[Noun]:
        """What a fragment names without a preposition, pronouns resolved."""
        found: list[Noun] = []
        for noun in fragment.nouns:
            if noun.pronoun in ("it", "them", "there"):
                found += [
                    n for n in self._waiting or self._last_targets() or self._named[-1:] if n not in found
                ]
            elif noun.pronoun == "one":
                found.append(self._resolve(noun))
                self._waiting = []
            else:
                found.append(self._resolve(noun))
        return found

    def _last_targets(self) -> list[Noun]:
        if not self._steps:
            return []
        last = next((s for s in reversed(self._steps) if s.landmark), self._steps[-1])
        if not last.landmark:
            return []
        same = [s for s in self._steps if s.landmark == last.landmark and s.relation == last.relation]
        return [Noun(s.target, s.part if not s.landmark else "", s.target_where) for s in dict.fromkeys(same)]

    def _resolve(self, noun: Noun) -> Noun:
        """A noun that leans on those before it: "the middle one", "that drawer"."""
        if noun.pronoun == "one" and self._named:
            last = (self._waiting or self._named)[-1]
            if noun.name in v.HEIGHTS or last.part:
                drawer = next((n for n in reversed(self._named) if n.part), last)
                height = v.HEIGHTS.get(noun.name)
                return replace(drawer, part=f"{height} {drawer.part.split()[-1]}") if height else drawer
            name = f"{noun.name} {last.name.split()[-1]}" if noun.name else last.name
            return Noun(name, "", noun.where or last.where)
        if noun.pronoun == "its" and self._named:
            return replace(noun, name=self._named[-1].name, pronoun="")
        if noun.pronoun:
            raise InstructionError(f"does not say what {noun.pronoun!r} is")
        if noun.part and len(noun.part.split()) == 1:  # "that drawer"
            whole = next((n for n in reversed(self._named) if n.part.endswith(f" {noun.part}")), None)
            return whole or noun
        if noun.name == "door":
            return next((n for n in reversed(self._named) if v.kind(n.name) in OPENED), noun)
        return noun

    def _pick_goal(self, phrases: Sequence[Phrase], fragment: Fragment) -> Phrase | None:
        """The phrase that says where to."""
        free = [p for p in phrases if not p.is_reference and not p.preposition.place]
        directed = [p for p in free if p.preposition.is_goal]
        if directed:
            return directed[-1]
        if fragment.operation == "pick":
            return None
        if not free and fragment.is_wish and fragment.nouns:  # "I'd like the bottle standing on the cabinet"
            free = [p for p in phrases if p.is_reference and not p.preposition.is_source and p.nouns]
        return free[-1] if free else None

    def _landmark(self, goal: Phrase, targets: Sequence[Noun]) -> tuple[Noun, str]:
        relation = "on" if goal.preposition.relation == "center" else goal.preposition.relation
        noun = goal.nouns[0] if goal.nouns else Noun(pronoun="it")
        if noun.pronoun in ("it", "them", "there"):
            targets = targets or self._waiting
            last = self._steps[-1] if self._steps else None
            if last is not None and last.landmark and noun.pronoun == "there":
                return Noun(last.landmark, last.part, last.landmark_where), last.relation
            if noun.pronoun == "there" and (found := self._spoken_of(targets)):
                return found
            taken = [t.name for t in targets]
            others = [n for n in self._named if n.name not in taken]
            if not goal.nouns:
                others = [n for n in others if canonical_name(n.name).split()[-1] in v.HOLLOW or n.part]
            if not others:
                raise InstructionError(f"does not say what {noun.pronoun!r} is")
            noun = others[-1]
        noun = self._resolve(noun)
        if relation == "at" and noun.part:
            relation = "in"
        if goal.preposition.is_inside and (part := v.PART_BY_PLACE.get(v.kind(noun.name))):
            noun, relation = replace(noun, part=f"{v.PLACE_OF_RELATION[relation]} {part}"), "in"
        return noun, relation

    def _spoken_of(self, targets: Sequence[Noun]) -> tuple[Noun, str] | None:
        """Where "there" is, if only said of the thing: "get it in front of the stove by pushing it there"."""
        where = targets[-1].where if targets else None
        if where is None or len(where.landmarks) != 1:
            return None
        relation = {"back": "behind"}.get(where.relation, where.relation)
        relation = f"{relation} of" if relation in ("front", "left", "right") else relation
        return Noun(where.landmarks[0]), relation

    def _which(self, noun: Noun, phrases: Sequence[Phrase]) -> Noun:
        """Give a noun the phrase that tells which of several it is."""
        phrase = phrases[-1]
        if phrase.preposition.place:
            return replace(noun, where=Reference(phrase.preposition.place))
        nouns = [self._resolve(n) for n in phrase.nouns if not n.pronoun]
        if not nouns:
            return noun
        relation = phrase.preposition.relation
        if relation in ("", "at"):
            relation = "in" if nouns[0].part or nouns[0].name.split()[-1] in v.HOLLOW else "on"
        relation = {"behind": "back"}.get(relation, relation.removesuffix(" of"))
        return replace(noun, where=Reference(relation, tuple(n.name for n in nouns)))
