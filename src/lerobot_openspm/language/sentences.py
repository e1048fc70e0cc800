"""An instruction's clauses, in the order they are said in and with the order they are to be done in."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.lexicon import Lexicon, Words
from lerobot_openspm.language.phrases import SAME, SEEN, WANTED, match_preposition
from lerobot_openspm.language.wording import plain_wording

# Nobody reads out more than this; and some patterns take time with the square of the length.
MAX_CHARACTERS = 500
_SUBJECTS = re.compile(
    r"^(?:you|it|that|this|they) (?:have|has|are|is)(?: (?:finished|done|been|through))?(?: with)? "
)


@dataclass(frozen=True)
class Clause:
    """Some words of an instruction that say one thing.

    Attributes:
        words: The words.
        step: Its place among the clauses in the order of execution.
        is_wanted: Whether something is asked for in it without a verb ("I'd like the soup in the basket").
        is_seen: Whether it only says what is spoken of ("you see the bowl by the plate?").
        is_same: Whether the clause before is to be done with another thing ("and so does the box").
        is_done: Whether it says what is done by then ("once the drawer is open").
    """

    words: Words
    step: int = 0
    is_wanted: bool = False
    is_seen: bool = False
    is_same: bool = False
    is_done: bool = False


def read_clauses(lex: Lexicon, instruction: str) -> list[Clause]:
    """Split an instruction into clauses.

    Raises:
        InstructionError: It asks, forbids, depends on a condition, or says nothing.
    """
    if len(instruction) > MAX_CHARACTERS:
        raise InstructionError(f"has {len(instruction)} characters, expected at most {MAX_CHARACTERS}")
    text = plain_wording(lex, instruction)
    if not text:
        raise InstructionError("says nothing, expected one like 'put the bowl on the plate'")
    for pattern, reason in lex.rewrites["refused"]:
        if match := pattern.search(text):
            raise InstructionError(f"{reason} (it says {match[0]!r})")
    found: list[Clause] = []
    for sentence in text.split(";"):
        if words := tuple(sentence.split()):
            found += _read_sentence(lex, words, len(found))
    polite = re.search(r"\bplease\b|\bkindly\b", instruction.lower())
    if polite and not any(
        lex.match_verb(clause.words, 0) for clause in found
    ):  # "soup in the basket, please"
        found = [replace(clause, is_wanted=True) for clause in found]
    return found


def _read_sentence(lex: Lexicon, words: Words, first_step: int) -> list[Clause]:
    # "could the bowl go on the stove" and "when the drawer is open, ..." ask for something.
    asks_for = words[0] in ("could", "would", "when") or words[:2] == ("have", "the")
    if words[0] in lex.question_words and not asks_for:
        raise InstructionError("is a question; say what to do")
    pieces = _split(lex, words)
    order = list(range(len(pieces)))
    for i, (marker, _) in enumerate(pieces):
        if marker == "before" and i == 0:  # "before closing the drawer, put the bowl in"
            order.append(order.pop(0))
        elif marker in ("after", "first") and i > 0:  # "put the bowl in after opening the drawer"
            order.remove(i)
            order.insert(0, i)
    clauses = [_clause(words, marker) for marker, words in pieces]
    told = next((i for i, one in enumerate(clauses) if one.is_wanted or lex.telling & set(one.words)), -1)
    return [
        replace(one, step=first_step + order.index(i), is_wanted=one.is_wanted or 0 <= told < i)
        for i, one in enumerate(clauses)
        if one.words
    ]


def _clause(words: Words, marker: str) -> Clause:
    if marker in ("after", "before"):
        words = tuple(_SUBJECTS.sub("", " ".join(words)).split())
        words = words[1:] if words[:1] in (("you",), ("finishing",)) else words
    marks = set(words) & {WANTED, SEEN, SAME}
    words = tuple(" ".join(word for word in words if word not in marks).lstrip(" ,").split())
    return Clause(words, 0, WANTED in marks, SEEN in marks, SAME in marks, marker == "after")


def _split(lex: Lexicon, words: Words) -> list[tuple[str, Words]]:
    """Split a sentence where another clause begins; each with how it is joined to the others."""
    pieces: list[tuple[str, Words]] = []
    current: list[str] = []
    marker, i = "", 0
    while i < len(words):
        end, next_marker = _joint(lex, words, i)
        if current and end >= len(words) and next_marker == "first":  # "but open it first"
            return [*pieces, ("first", tuple(current))]
        if end > i and (not current or _is_boundary(lex, words, i, end, next_marker, tuple(current))):
            if current:
                pieces.append((marker, tuple(current)))
            current, marker, i = [], next_marker, end
        else:
            current.append(words[i])
            i += 1
    return [*pieces, (marker, tuple(current))] if current else pieces


def _joint(lex: Lexicon, words: Words, at: int) -> tuple[int, str]:
    """Where the words that join two clauses end, and what they say of the order."""
    marker, end = "", at
    while end < len(words) and words[end : end + 2] != ("next", "to"):
        ahead = " ".join(words[end : end + 3])
        if ahead.startswith(("before that", "first")) and (at > 0 or "that" in ahead[:11]):
            marker, end = "first", end + (2 if ahead.startswith("before that") else 1)
        elif ahead.startswith(("after that", "after this", "after which", "once that is", "when that is")):
            marker, end = "then", end + (2 if ahead.startswith("after") else 3)
            end += words[end : end + 1] == ("done",)
        elif phrase := lex.longest(words, end, lex.after):
            return end + len(phrase.split()), "after"
        elif words[end] == "before":
            return end + 1, "before"
        elif words[end] == "to" and has_object(lex, words, end + 1):  # "open the drawer to put the bowl in"
            marker, end = "then", end + 1
        elif words[end] in lex.joints:
            marker = "then" if words[end] in lex.parting and marker != "first" else marker
            end += 1
        else:
            break
    return end, marker


def has_object(lex: Lexicon, words: Words, at: int) -> bool:
    """Whether a verb begins at a word, and something that it is done to follows."""
    verb = lex.match_verb(words, at)
    after = words[at + verb.length] if verb and at + verb.length < len(words) else ""
    return after in lex.determiners or after in lex.pronouns or lex.number(after) > 0


def _is_boundary(lex: Lexicon, words: Words, at: int, end: int, marker: str, current: Words) -> bool:
    if end >= len(words) or marker in ("after", "before"):
        return True
    if words[at] == "and" and {words[at - 1], words[end]} <= lex.colours:
        return False  # "the yellow and white mug"
    if words[at] == "," and end == at + 1 and _is_fronted(lex, current):
        return False  # "on the plate, put the bowl"
    if words[at] == "first" and end == at + 1 and marker == "first":  # "open the drawer first, then ..."
        return lex.match_verb(words, end) is not None
    return marker == "then" or words[end] == SAME or _begins_clause(lex, words, end, current)


def _is_fronted(lex: Lexicon, words: Words) -> bool:
    """Whether words are a phrase alone: "on top of the cabinet"."""
    return match_preposition(lex, words, 0) is not None and not any(
        lex.match_verb(words, i) and words[i + 1 : i + 2] and words[i + 1] in lex.determiners
        for i in range(len(words))
    )


def _begins_clause(lex: Lexicon, words: Words, at: int, current: Words) -> bool:
    if words[at] in lex.predicates:
        return False  # "the bowl, which is on the stove, goes on the plate"
    if lex.match_verb(words, at, "base", "gerund") or words[at] in (WANTED, SEEN):
        return True
    says_more = (
        current[-1] in lex.results or _has_relation(lex, current) or bool(lex.predicates & set(current))
    )
    pairs = "between" in current[-4:] and "and" not in current[-4:]
    if pairs or not (says_more or lex.match_verb(current, 0)):
        return False  # the first half of "the yellow and white mug"
    rest = words[at:]
    end = next(
        (i for i, word in enumerate(rest) if (i and word == ",") or lex.match_verb(rest, i)), len(rest)
    )
    if any(word in lex.predicates for word in rest[1:end]):
        return True
    if match_preposition(lex, words, at) is not None:
        return False
    # "put the bowl on the plate and the bottle on the rack"
    is_told = rest[end - 1] in lex.results or any(
        lex.match_verb(rest, i, "participle") for i in range(1, end)
    )
    return says_more and (is_told or _has_relation(lex, rest[:end]))


def _has_relation(lex: Lexicon, words: Words) -> bool:
    """Whether there is a preposition behind the first word."""
    return any(match_preposition(lex, words, i) for i in range(1, len(words)))
