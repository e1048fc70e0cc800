"""Instructions that the grammar cannot read: kept, compared and found again by their own words.

"Wipe the table with the sponge" has no verb of the grammar. It is split at its prepositions into a verb and
noun phrases, which is enough to compare two wordings and to name the things that the hand may touch.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.lexicon import ENGLISH, Lexicon, Words
from lerobot_openspm.language.names import NameSimilarity
from lerobot_openspm.language.sentences import plain_words, spelled
from lerobot_openspm.types import OWN_WORDS, SubTask

# One phrase fewer than the demonstration's instruction has: "wipe the table" for "... with the sponge".
PHRASE_UNSAID = 0.9
# Other words that mean the same.
NOT_VERBATIM = 0.99
# A name that is made of words is cut here.
MAX_NAME = 60

_WITH = "with"
# What one thing after another is said with: "wipe the table, and then open the drawer".
_NEXT = re.compile(r"(?:\band )?\bthen\b|[;.!?\n]+", re.IGNORECASE)
_AND = re.compile(r"\band\b", re.IGNORECASE)
# Verbs whose last letter doubles before "-ing": "tapping" is of "tap", so "taping" is not.
_DOUBLES = re.compile("[^aeiou]*[aeiou][^aeiouwxy]")
# Where a thing ends that is put, poured or laid there.
_GOALS = {"on": "on", "in": "in", "under": "under", "over": "on", "at": "at", "between": "between"}
_JOINTS = ("and", "then")


@dataclass(frozen=True)
class _Clause:
    """A verb, and what follows it as pairs of a preposition's role and a noun; "" has no preposition."""

    verb: str
    phrases: tuple[tuple[str, str], ...]


@lru_cache(maxsize=16384)
def normal_words(instruction: str, lex: Lexicon = ENGLISH) -> str:
    """An instruction's words without case, articles, courtesies and punctuation; in any language.

    "Could you please wipe the table?" and "wipe table" are the same. Accents and vowel signs stay, because
    they tell words apart.
    """
    own = [word.strip(",;'") for word in spelled(lex, instruction).split()]
    kept: list[str] = []
    letters = unicodedata.normalize("NFKD", instruction)
    if all(letter.isascii() for letter in letters if letter.isalpha()):  # else it has no English articles
        words = tuple(plain_words(lex, instruction).split())
        kept = [word for i, word in enumerate(words) if not _is_article(lex, words, i)]
    return " ".join(kept or filter(None, own))


def _is_article(lex: Lexicon, words: Words, i: int) -> bool:
    """Whether a word adds nothing; "a" does where it is a label: "put block a on block b", "the a button"."""
    if words[i] != "a":
        return words[i] in lex.articles
    if i > 0 and words[i - 1] in lex.determiners:
        return False
    return i + 1 < len(words) and not _role_at(lex, words, i + 1)[0] and words[i + 1] not in _JOINTS


def unread(instruction: str, lex: Lexicon = ENGLISH) -> SubTask:
    """An instruction as one thing to do, kept by its words, with the names of things that they give.

    What follows "with" is taken to be in the hand ("wipe the table with the sponge"), else what follows the
    verb. Where the words name nothing that a hand can move, the target is named after them.

    Raises:
        InstructionError: There is not a word in it.
    """
    words = normal_words(instruction, lex)
    if not words:
        raise InstructionError("says nothing, expected one like 'put the bowl on the plate'")
    said = [(role, _thing(lex, noun)) for clause in _clauses(lex, words) for role, noun in clause.phrases]
    phrases = [phrase for phrase in said if phrase[1]]
    tools = [phrase for phrase in phrases if phrase[0] == _WITH]
    moved = tools or [phrase for phrase in phrases if not phrase[0]] or phrases
    target = moved[0][1] if moved else f"{words[:MAX_NAME].strip()} object"
    others = [phrase for phrase in phrases if phrase[1] != target]
    goals = [phrase for phrase in others if phrase[0] in _GOALS and not tools]
    role, landmark = (goals or others or [("", "")])[0]
    return SubTask(OWN_WORDS, target, "", _GOALS[role] if goals else "", landmark, words=words)


def _thing(lex: Lexicon, noun: str) -> str:
    """The thing that a noun names, without words behind it that name none: "drawer halfway" is the drawer.

    "" where there is none, or just the table, which no hand takes hold of.
    """
    words = noun.split()
    no_things = lex.no_things | lex.ways | lex.particles
    while words and ({words[-1], f"{words[-1]}s"} & no_things or lex.number(words[-1])):
        words.pop()
    return "" if not words or words[-1] in lex.surfaces else " ".join(words)


def words_similarity(asked: str, known: str, names: NameSimilarity) -> float:
    """How alike two instructions are by their :func:`normal_words`, 0 to 1.

    Every verb has to be the same, and every noun of one has to be in the other with the same preposition. The
    order of the phrases behind a verb does not matter, that of the clauses does. One phrase with a
    preposition may be left unsaid.
    """
    if asked == known:
        return 1.0
    a, k = _clauses(names.lexicon, asked), _clauses(names.lexicon, known)
    if len(a) != len(k):
        return 0.0
    # Just the same words come before words that only mean the same.
    return NOT_VERBATIM * min(_clause_score(one, other, names) for one, other in zip(a, k, strict=True))


def _clause_score(asked: _Clause, known: _Clause, names: NameSimilarity) -> float:
    is_same_verb = bool(_base_forms(names.lexicon, asked.verb) & _base_forms(names.lexicon, known.verb))
    score = 1.0 if is_same_verb else names.similarity(asked.verb, known.verb)
    left = list(asked.phrases)
    unsaid = 0
    for role, noun in known.phrases:
        found = {i: _same(said, noun, names) for i, (other, said) in enumerate(left) if other == role}
        best = max(found, key=lambda i: found[i], default=-1)
        if best >= 0 and found[best] > 0:
            score *= found[best]
            left.pop(best)
        elif role and noun:
            unsaid += 1
        else:
            return 0.0
    return 0.0 if left or unsaid > 1 else score * PHRASE_UNSAID**unsaid


def _same(asked: str, known: str, names: NameSimilarity) -> float:
    """How alike two nouns are; singular and plural are one, a tub and a tube are not."""
    if [*map(names.lexicon.singular, asked.split())] == [*map(names.lexicon.singular, known.split())]:
        return 1.0
    if ("other" in asked.split()) != ("other" in known.split()):
        return 0.0  # the other button is not the button
    return names.similarity(asked, known)


def _base_forms(lex: Lexicon, verb: str) -> set[str]:
    """What a verb may be a form of: "wiping" and "wipes" of "wipe"; "tap" and "tape" only of themselves."""
    forms = {verb, lex.singular(verb)}
    if verb.endswith("ing") and len(verb) > 5:
        stem = verb[:-3]
        forms.add(f"{stem}e")
        if stem[-1] == stem[-2]:
            forms |= {stem, stem[:-1]}
        elif not _DOUBLES.fullmatch(stem):
            forms.add(stem)
    return forms


def split_steps(instruction: str, lex: Lexicon = ENGLISH) -> list[str]:
    """What is asked one after another, joined by "then" or a full stop, else by "and"; none for one step."""
    for joint in (_NEXT, _AND):
        steps = [step for step in joint.split(instruction) if normal_words(step, lex)]
        if len(steps) > 1:
            return steps
    return []


@lru_cache(maxsize=4096)
def _clauses(lex: Lexicon, words: str) -> tuple[_Clause, ...]:
    """Split :func:`normal_words` into clauses, each into a verb and its phrases."""
    pieces: list[list[str]] = [[]]
    for word in words.split():
        if word not in _JOINTS:
            pieces[-1].append(word)
        elif pieces[-1]:
            pieces.append([])
    return tuple(_clause(lex, piece) for piece in pieces if piece)


def _clause(lex: Lexicon, words: Sequence[str]) -> _Clause:
    verb, rest = words[0], tuple(words[1:])
    phrases: list[tuple[str, list[str]]] = [("", [])]
    i = 0
    while i < len(rest):
        role, length = _role_at(lex, rest, i)
        if role:
            phrases.append((role, []))
        else:
            phrases[-1][1].append(rest[i])
        i += max(1, length)
    if len(phrases) > 1 and not phrases[0][1] and phrases[1][0] in ("on", "off", "up", "down", "out", "open"):
        # "turn on the tap" is "turn the tap on".
        phrases[:2] = [("", phrases[1][1]), (phrases[1][0], [])]
    named = ((role, " ".join([*nouns[:-1], *map(lex.singular, nouns[-1:])])) for role, nouns in phrases)
    return _Clause(verb, tuple((role, noun) for role, noun in named if role or noun))


def _role_at(lex: Lexicon, words: Words, i: int) -> tuple[str, int]:
    """The role of the longest preposition that begins at a word and its length; "" and 0 without one."""
    phrase = max(lex.longest(words, i, lex.roles), lex.longest(words, i, lex.relations), key=len)
    return lex.roles.get(phrase) or lex.relations.get(phrase, ""), len(phrase.split())
