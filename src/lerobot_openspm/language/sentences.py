"""An instruction's clauses, in the order they are said in and with the order they are to be done in."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.language.constructions import SAME, SEEN, WANTED
from lerobot_openspm.language.prepositions import match_preposition
from lerobot_openspm.language.wording import plain_wording

Words = tuple[str, ...]

# Nobody reads out more than this; and some patterns take time with the square of the length.
MAX_CHARACTERS = 500
_REFUSED = (
    ("not|never|no|nor|neither|without|avoid|refrain|cancel|stop|except|instead|rather|undo|abort|wrong"
     "|prevent|forget|nothing|none|forbidden|hardly",
     "says what not to do; say what to do"),
    ("if|unless|until|otherwise|whether|in case|provided|only|should the|while|whenever|as long as",
     "depends on a condition, which is not judged here; say what to do"),
    ("or|either", "leaves a choice; name one thing"),
    (r"\w+ times|twice|every|forever", "says how often; give one instruction at a time"),
    ("seconds|minutes?|hours?|days?|tomorrow|tonight", "says when; give it when it is to be done"),
)  # fmt: skip
_QUESTION = v.word_set(
    "what which who whose where when why how is are was were am do does did has have had should "
    "shall may might can could will would"
)
# Words between clauses, and those among them that always part two.
_JOINTS = v.word_set(
    "and then so but also next finally afterwards afterward subsequently later lastly first firstly "
    "second secondly third thirdly thereafter , ; followed by"
)
_PARTING = v.word_set(
    "then next finally afterwards afterward subsequently later lastly secondly thirdly thereafter ; followed"
)
_AFTER = ("as soon as", "after", "once", "when", "having")
_SUBJECTS = re.compile(
    r"^(?:you|it|that|this|they) (?:have|has|are|is)(?: (?:finished|done|been|through))?(?: with)? "
)
# "the stove should be on and the pan on it": said once, it holds for the rest of the sentence.
_TELLING = frozenset({"should", "must", "needs", "goes"})
# What may stand between a subject and what is to become of it.
PREDICATES = v.word_set("goes go belongs belong should must needs need has have ought is are be gets")


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


def read_clauses(instruction: str) -> list[Clause]:
    """Split an instruction into clauses.

    Raises:
        InstructionError: It asks, forbids, depends on a condition, or says nothing.
    """
    if len(instruction) > MAX_CHARACTERS:
        raise InstructionError(f"has {len(instruction)} characters, expected at most {MAX_CHARACTERS}")
    text = plain_wording(instruction)
    if not text:
        raise InstructionError("says nothing, expected one like 'put the bowl on the plate'")
    refuse_what_asks_for_nothing(text)
    found: list[Clause] = []
    for sentence in text.split(";"):
        if words := tuple(sentence.split()):
            found += _read_sentence(words, len(found))
    polite = re.search(r"\bplease\b|\bkindly\b", instruction.lower())
    if polite and not any(v.match_verb(clause.words, 0) for clause in found):  # "soup in the basket, please"
        found = [replace(clause, is_wanted=True) for clause in found]
    return found


def refuse_what_asks_for_nothing(text: str) -> None:
    """Check a text in plain words.

    Raises:
        InstructionError: It forbids, depends on a condition, leaves a choice, or says when or how often.
    """
    for words, reason in _REFUSED:
        if match := re.search(rf"\b(?:{words})\b", text):
            raise InstructionError(f"{reason} (it says {match[0]!r})")


def is_question(words: Words) -> bool:
    """Whether a sentence asks something rather than for something."""
    if words[0] == "have":
        return words[1:2] in (("you",), ("they",), ("we",), ("i",))
    return words[0] in _QUESTION - {"will", "can", "could", "would"} and not _is_request(words)


def _read_sentence(words: Words, first_step: int) -> list[Clause]:
    if words[0] in _QUESTION and not _is_request(words):
        raise InstructionError("is a question; say what to do")
    pieces = _split(words)
    order = list(range(len(pieces)))
    for i, (marker, _) in enumerate(pieces):
        if marker == "before" and i == 0:  # "before closing the drawer, put the bowl in"
            order.append(order.pop(0))
        elif marker in ("after", "first") and i > 0:  # "put the bowl in after opening the drawer"
            order.remove(i)
            order.insert(0, i)
    clauses = [_clause(words, marker) for marker, words in pieces]
    told = next(
        (i for i, clause in enumerate(clauses) if clause.is_wanted or _TELLING & set(clause.words)),
        len(clauses),
    )
    clauses[told + 1 :] = [replace(clause, is_wanted=True) for clause in clauses[told + 1 :]]
    return [
        replace(clause, step=first_step + order.index(i)) for i, clause in enumerate(clauses) if clause.words
    ]


def _is_request(words: Words) -> bool:
    """Whether it asks for something: "could the bowl go on the stove", "when the drawer is open, ..."."""
    return words[0] in ("could", "would", "when") or (words[0] == "have" and words[1:2] == ("the",))


def _clause(words: Words, marker: str) -> Clause:
    if marker in ("after", "before"):
        words = tuple(_SUBJECTS.sub("", " ".join(words)).split())
        words = words[1:] if words[:1] in (("you",), ("finishing",)) else words
    marks = set(words) & {WANTED, SEEN, SAME}
    words = tuple(word for word in words if word not in marks)
    while words and words[0] == ",":
        words = words[1:]
    return Clause(words, 0, WANTED in marks, SEEN in marks, SAME in marks, marker == "after")


def _split(words: Words) -> list[tuple[str, Words]]:
    """Split a sentence where another clause begins; each with how it is joined to the others."""
    pieces: list[tuple[str, Words]] = []
    current: list[str] = []
    marker, i = "", 0
    while i < len(words):
        end, next_marker = _joint(words, i)
        if current and end >= len(words) and next_marker == "first":  # "but open it first"
            return [*pieces, ("first", tuple(current))]
        if end > i and (not current or _is_boundary(words, i, end, next_marker, tuple(current))):
            if current:
                pieces.append((marker, tuple(current)))
            current, marker, i = [], next_marker, end
        else:
            current.append(words[i])
            i += 1
    return [*pieces, (marker, tuple(current))] if current else pieces


def _joint(words: Words, at: int) -> tuple[int, str]:
    """Where the words that join two clauses end, and what they say of the order."""
    marker, end = "", at
    while end < len(words) and words[end : end + 2] != ("next", "to"):
        ahead = " ".join(words[end : end + 3])
        if ahead.startswith(("before that", "first")) and (at > 0 or "that" in ahead[:11]):
            marker, end = "first", end + (2 if ahead.startswith("before that") else 1)
        elif ahead.startswith(("after that", "after this", "after which", "once that is", "when that is")):
            marker, end = "then", end + (2 if ahead.startswith("after") else 3)
            end += words[end : end + 1] == ("done",)
        elif phrase := next((p for p in _AFTER if f"{ahead} ".startswith(f"{p} ")), None):
            return end + len(phrase.split()), "after"
        elif words[end] == "before":
            return end + 1, "before"
        elif words[end] == "to" and _has_object(words, end + 1):  # "open the drawer to put the bowl in"
            marker, end = "then", end + 1
        elif words[end] in _JOINTS:
            marker = "then" if words[end] in _PARTING and marker != "first" else marker
            end += 1
        else:
            break
    return end, marker


def _has_object(words: Words, at: int) -> bool:
    """Whether a verb begins at a word, and something that it is done to follows."""
    verb = v.match_verb(words, at)
    after = words[at + verb.length] if verb and at + verb.length < len(words) else ""
    return after in v.DETERMINERS or after in v.PRONOUNS or after in v.NUMBERS


def _is_boundary(words: Words, at: int, end: int, marker: str, current: Words) -> bool:
    if end >= len(words):
        return True
    if marker in ("after", "before"):
        return True
    if words[at] == "and" and {words[at - 1], words[end]} <= v.COLOURS:
        return False  # "the yellow and white mug"
    if words[at] == "," and end == at + 1 and _is_fronted(current):
        return False  # "on the plate, put the bowl"
    if words[at] == "first" and end == at + 1 and marker == "first":  # "open the drawer first, then ..."
        return v.match_verb(words, end) is not None
    return marker == "then" or words[end] == SAME or _begins_clause(words, end, current)


def _is_fronted(words: Words) -> bool:
    """Whether words are a phrase alone: "on top of the cabinet"."""
    return match_preposition(words, 0) is not None and not any(
        v.match_verb(words, i) and words[i + 1 : i + 2] and words[i + 1] in v.DETERMINERS
        for i in range(len(words))
    )


def _begins_clause(words: Words, at: int, current: Words) -> bool:
    if words[at] in PREDICATES:
        return False  # "the bowl, which is on the stove, goes on the plate"
    if v.match_verb(words, at) or v.match_verb(words, at, "gerund") or words[at] in (WANTED, SEEN):
        return True
    pairs = "between" in current[-4:] and "and" not in current[-4:]
    if pairs or not _is_complete(current):
        return False
    rest = words[at:]
    end = next((i for i, word in enumerate(rest) if (i and word == ",") or v.match_verb(rest, i)), len(rest))
    if any(word in PREDICATES for word in rest[1:end]):
        return True
    if match_preposition(words, at) is not None:
        return False
    # "put the bowl on the plate and the bottle on the rack"
    is_told = rest[end - 1] in v.RESULTS or any(v.match_verb(rest, i, "participle") for i in range(1, end))
    return _is_said(current) and (is_told or _relation_at(rest[:end]) > 0)


def _is_said(words: Words) -> bool:
    """Whether words say of something where it is or what becomes of it."""
    return _relation_at(words) > 0 or words[-1] in v.RESULTS or bool(PREDICATES & set(words))


def _is_complete(words: Words) -> bool:
    """Whether words can be a clause: not the first half of "the yellow and white mug"."""
    return (
        v.match_verb(words, 0) is not None
        or words[-1] in v.RESULTS
        or _relation_at(words) > 0
        or bool(PREDICATES & set(words))
    )


def _relation_at(words: Sequence[str]) -> int:
    """Where the first preposition stands; 0 if there is none."""
    return next((i for i in range(1, len(words)) if match_preposition(tuple(words), i)), 0)
