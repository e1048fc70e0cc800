"""Whether a reading has every word that tells its task from others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from lerobot_openspm.language.lexicon import FORMS, Lexicon, Words
from lerobot_openspm.language.phrases import Preposition, match_preposition
from lerobot_openspm.language.sentences import plain_words
from lerobot_openspm.types import SubTask

# Operations that say all of what becomes of a thing.
_MADE = frozenset({"open", "close", "turn on", "turn off"})
# What moves along a way that "to the left" tells, where anything else is so told from others of its name.
_MOVED_ALONG = frozenset({"push", "open", "close"})


def says_all(lex: Lexicon, sub_tasks: Sequence[SubTask], instruction: str) -> bool:
    """Whether a reading has every word of an instruction that tells its task from others.

    "Push the lever up" says more than a push of the lever, and "the second mug" is not any mug. A thing that
    is only taken or pushed is so by a verb that says nothing more.

    Args:
        lex: The words that it was read by.
        sub_tasks: What the grammar read.
        instruction: What was said.
    """
    words = tuple(plain_words(lex, instruction).split())
    goes = any(sub_task.landmark for sub_task in sub_tasks)
    if not goes and len(sub_tasks) == 1 and sub_tasks[0].operation in ("put", "push"):
        verb = lex.match_verb(words, 0)
        if verb is None or " ".join(words[: verb.length]) not in lex.complete_verbs:
            return False
    wheres = (where for s in sub_tasks for where in (s.target_where, s.landmark_where) if where)
    named = [
        *(name for s in sub_tasks for name in s.objects),
        *(name for w in wheres for name in w.landmarks),
    ]
    names = frozenset(" ".join(named).split())
    if names & {*lex.how, *lex.ways, *lex.ordinals, "with", "using", "it", "them"} or _is_another(lex, words):
        return False
    moves = frozenset(sub_task.operation for sub_task in sub_tasks if not sub_task.landmark)
    ends = [i for i, word in enumerate(words) if word in (",", ";", "and", "then")]
    for i, j in pairwise([-1, *ends, len(words)]):
        if not _Piece(lex, words[i + 1 : j], names, moves, goes).is_said():
            return False
    return True


def _is_another(lex: Lexicon, words: Words) -> bool:
    """Whether "the other button" is said where no button was spoken of before: then it tells which."""
    for i in (i for i, word in enumerate(words) if word == "other"):
        rest = words[i + 1 :]
        ends = (j for j in range(len(rest)) if rest[j] in lex.joints or match_preposition(lex, rest, j))
        noun = rest[: next(ends, len(rest))]
        if noun and noun[0] != "one" and lex.singular(noun[-1]) not in map(lex.singular, words[:i]):
            return True
    return False


@dataclass(frozen=True)
class _Piece:
    """Words between commas, "and" and "then".

    Attributes:
        lex: The words that they are read by.
        words: The words.
        names: Words of the names that were read.
        moves: Operations of sub-tasks without a landmark.
        goes: Whether anything has a landmark.
    """

    lex: Lexicon
    words: Words
    names: frozenset[str]
    moves: frozenset[str]
    goes: bool

    def is_said(self) -> bool:
        """Whether no telling word is left over by verbs, names and prepositions of a reading."""
        i, left, has_goal = 0, set[str](), False
        while i < len(self.words):
            word = self.words[i]
            verb = self.lex.match_verb(self.words, i, *FORMS)
            found = match_preposition(self.lex, self.words, i)
            if verb is not None and verb.length > 1:
                i += verb.length
            elif found is not None and not (word in ("off", "out") and self.moves & _MADE):
                if not self._is_read(found, i):
                    return False
                has_goal |= not (found.place or found.is_source)
                i += found.length
            else:
                left |= {word} if word not in self.names and self._tells(i) else set()
                i += 1
        adds_nothing = self.lex.particles | self.lex.beside_goals if has_goal else frozenset[str]()
        return not left - adds_nothing

    def _is_read(self, found: Preposition, i: int) -> bool:
        """Whether a reading has what a preposition says: where something goes, or which thing is meant."""
        if found.place:
            return self.words[i] not in self.lex.goals or not _MOVED_ALONG & self.moves
        after = i + found.length
        if found.is_source:
            return "push" not in self.moves and after < len(self.words)
        is_infinitive = self.words[after : after + 1] == ("be",) or self.lex.match_verb(self.words, after)
        return self.goes or not found.is_goal or bool(is_infinitive)

    def _tells(self, i: int) -> bool:
        """Whether a word tells which, how far or which way; "left" before a noun and "first" alone do not."""
        lex, words, word = self.lex, self.words, self.words[i]
        before, after = words[i - 1] if i else "", words[i + 1] if i + 1 < len(words) else ""
        if f"{words[0]} {word}" in lex.complete_verbs:
            return False  # "lift the box up"
        has_noun = bool(after) and match_preposition(lex, words, i + 1) is None
        if word in lex.sides:
            return not has_noun and before not in ("'s", "furthest", "farthest")
        if word in lex.signs:
            return after not in lex.determiners  # "the mug plus the bowl"
        if word in lex.ordinals:
            return has_noun and after not in lex.determiners and lex.match_verb(words, i + 1) is None
        if word in ("off", "out"):
            return not self.moves & _MADE  # "turn the stove off"
        if word == "a":
            return not has_noun or before in lex.determiners
        if word in ("little", "bit", "slightly", "once"):
            return not after
        return word in lex.how or word in lex.ways or (len(word) == 1 and word.isalpha() and word != "i")
