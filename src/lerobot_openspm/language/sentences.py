"""An instruction's sentences in plain wording, and their clauses with the order they are to be done in."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.lexicon import Lexicon, Words
from lerobot_openspm.language.phrases import SAME, SEEN, WANTED, match_preposition

# Nobody reads out more than this; and some patterns take time with the square of the length.
MAX_CHARACTERS = 500
_SUBJECTS = re.compile(
    r"^(?:you|it|that|this|they) (?:have|has|are|is)(?: (?:finished|done|been|through))?(?: with)? "
)

# How a clause is joined to the others ("before", "after", "first", "then" or ""), and its words.
Piece = tuple[str, Words]


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


@lru_cache(maxsize=4096)
def plain_words(lex: Lexicon, text: str) -> str:
    """Words as :func:`spelled`, without courtesies."""
    return _rewritten(lex, "courtesies", _collapsed(spelled(lex, text)))


def spelled(lex: Lexicon, text: str) -> str:
    """Lower-case words with "," and ";" between clauses and sentences.

    Letters keep their accents and vowel signs, which tell words apart; signs such as "+" become words.
    """
    text = unicodedata.normalize("NFC", text).lower()
    if re.match(r"\s*\(?1[.):]", text):  # "1. open the drawer 2. put the bowl in it", but not "block 1."
        text = re.sub(r"(?:^|\s)\(?\d[.):]\s+", " ; ", text)
    for pattern, other in lex.rewrites["spelling"]:
        text = pattern.sub(other, text)
    # No regular expression knows combining marks.
    return "".join(c if c in ",;'" or unicodedata.category(c)[0] in "LMN" else " " for c in text)


@lru_cache(maxsize=4096)
def plain_wording(lex: Lexicon, text: str) -> str:
    """Plain words with other constructions made imperatives, and the marks of :mod:`phrases`."""
    return _rewritten(lex, "constructions", plain_words(lex, text))


def _rewritten(lex: Lexicon, step: str, text: str) -> str:
    for pattern, other in lex.rewrites[step]:
        text = _collapsed(pattern.sub(other, text))
    return text


def _collapsed(text: str) -> str:
    text = re.sub(r"\s+", " ", text)
    text = re.sub(r"(?: ?,)+(?= ?[,;]|$)|(?<=;)(?: ?,)+", "", text.strip())
    return re.sub(r"(?:; ?)+(?=;)|^[ ,;]+|[ ,;]+$", "", text).strip()


def read_sentences(lex: Lexicon, instruction: str) -> list[Words]:
    """The sentences of an instruction in plain wording.

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
    found = [tuple(sentence.split()) for sentence in text.split(";") if sentence.strip()]
    for words in found:
        # "could the bowl go on the stove" and "when the drawer is open, ..." ask for something.
        asks_for = words[0] in ("could", "would", "when") or words[:2] == ("have", "the")
        if words[0] in lex.question_words and not asks_for:
            raise InstructionError("is a question; say what to do")
    return found


def as_clauses(lex: Lexicon, sentences: Iterable[Sequence[Piece]], is_polite: bool) -> list[Clause]:
    """The clauses that sentences were split into, with the order in which they are to be done.

    Args:
        lex: The words.
        sentences: Each as :func:`split_sentence` split it.
        is_polite: Whether something is asked for, also where no verb says so: "soup in the basket, please".
    """
    found: list[Clause] = []
    for pieces in sentences:
        order = list(range(len(pieces)))
        for i, (marker, _) in enumerate(pieces):
            if marker == "before" and i == 0:  # "before closing the drawer, put the bowl in"
                order.append(order.pop(0))
            elif marker in ("after", "first") and i > 0:  # "put the bowl in after opening the drawer"
                order.remove(i)
                order.insert(0, i)
        clauses = [_clause(words, marker) for marker, words in pieces]
        wanting = (i for i, one in enumerate(clauses) if one.is_wanted or lex.telling & set(one.words))
        told = next(wanting, -1)
        first_step = len(found)
        found += [
            replace(one, step=first_step + order.index(i), is_wanted=one.is_wanted or 0 <= told < i)
            for i, one in enumerate(clauses)
            if one.words
        ]
    if is_polite and not any(lex.match_verb(clause.words, 0) for clause in found):
        found = [replace(clause, is_wanted=True) for clause in found]
    return found


def _clause(words: Words, marker: str) -> Clause:
    if marker in ("after", "before"):
        words = tuple(_SUBJECTS.sub("", " ".join(words)).split())
        words = words[1:] if words[:1] in (("you",), ("finishing",)) else words
    marks = set(words) & {WANTED, SEEN, SAME}
    words = tuple(" ".join(word for word in words if word not in marks).lstrip(" ,").split())
    return Clause(words, 0, WANTED in marks, SEEN in marks, SAME in marks, marker == "after")


def split_sentence(lex: Lexicon, words: Words) -> list[Piece]:
    """Split a sentence where another clause begins; each with how it is joined to the others."""
    pieces: list[Piece] = []
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
    """Whether another clause begins behind the joining words from `at` to `end`; `current` is before them."""
    if end >= len(words) or marker in ("after", "before"):
        return True
    if words[at] == "and" and {words[at - 1], words[end]} <= lex.colours:
        return False  # "the yellow and white mug"
    if words[at] == "," and end == at + 1 and _is_fronted(lex, current):
        return False  # "on the plate, put the bowl"
    if words[at] == "first" and end == at + 1 and marker == "first":  # "open the drawer first, then ..."
        return lex.match_verb(words, end) is not None
    if marker == "then" or words[end] == SAME:
        return True
    if words[end] in lex.predicates:
        return False  # "the bowl, which is on the stove, goes on the plate"
    if lex.match_verb(words, end, "base", "gerund") or words[end] in (WANTED, SEEN):
        return True
    relations = [i for i in range(1, len(current)) if match_preposition(lex, current, i)]
    says_more = current[-1] in lex.results or bool(relations or lex.predicates & set(current))
    pairs = "between" in current[-4:] and "and" not in current[-4:]
    if pairs or not (says_more or lex.match_verb(current, 0)):
        return False  # the first half of "the yellow and white mug"
    rest = words[end:]
    stop = next(
        (i for i, word in enumerate(rest) if (i and word == ",") or lex.match_verb(rest, i)), len(rest)
    )
    if any(word in lex.predicates for word in rest[1:stop]):
        return True
    if match_preposition(lex, words, end) is not None:
        return False
    if rest[stop - 1] in lex.results or any(lex.match_verb(rest, i, "participle") for i in range(1, stop)):
        return says_more
    # "put the bowl on the plate and the bottle on the rack"
    relations = [i for i in range(1, stop) if match_preposition(lex, rest[:stop], i)]
    return says_more and bool(relations)


def _is_fronted(lex: Lexicon, words: Words) -> bool:
    """Whether words are a phrase alone: "on top of the cabinet"."""
    return match_preposition(lex, words, 0) is not None and not any(
        lex.match_verb(words, i) and words[i + 1 : i + 2] and words[i + 1] in lex.determiners
        for i in range(len(words))
    )
