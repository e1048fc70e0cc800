"""The words that instructions are read by: ``lexicon.yaml``, and what a user's file of the same form adds."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, cast, get_args

import yaml

from lerobot_openspm.errors import LexiconError
from lerobot_openspm.files import read_text

Words = tuple[str, ...]
# What a key of the file holds: words or phrases, words with what they mean, regular expressions, and those
# with what they are replaced by.
WordSet = frozenset[str]
Table = Mapping[str, str]
Patterns = tuple[str, ...]
Rules = tuple[tuple[str, str], ...]

# What the robot can be asked to do. "pick" is half of a put.
OPERATIONS = ("pick", "put", "open", "close", "push", "turn on", "turn off")
# Where a thing can be asked to go, relative to another.
RELATIONS = ("on", "in", "next to", "between", "behind", "front of", "left of", "right of", "under", "at")
PLACES, HEIGHTS = ("left", "right", "front", "back", "middle"), ("top", "bottom")
# How one of several things is told from the others: by its place, or by its relation to other things.
REFERENCES = (*PLACES, *HEIGHTS, "center", "on", "in", "next to", "between", "under", "at")
# The meanings that a table may give to words; the other tables may give any.
_MEANINGS: dict[str, tuple[str, ...]] = {
    "verbs": OPERATIONS, "relations": RELATIONS, "places": PLACES, "heights": HEIGHTS,
    "results": OPERATIONS, "drawer_results": OPERATIONS, "sources": ("", *RELATIONS),
    "pronouns": ("it", "them", "there"), "numbers": tuple(map(str, range(2, 100))),
}  # fmt: skip
# What "turn" means without "on" or "off".
HALF_A_VERB = "half a verb"

Form = Literal["base", "gerund", "participle", "third"]
FORMS: tuple[Form, ...] = get_args(Form)
_LONGEST = 4  # words of a phrase
MAX_BYTES = 2**20  # of a user's file
_LOADER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


@dataclass(frozen=True)
class Verb:
    """A verb phrase as it stands in an instruction.

    Attributes:
        operation: What it means, one of :data:`OPERATIONS` or :data:`HALF_A_VERB`.
        word: Its first word in its base form.
        length: How many words it has.
    """

    operation: str
    word: str
    length: int


@dataclass(frozen=True, eq=False)
class Lexicon:
    """The words of ``lexicon.yaml``, which says what each field is for.

    Attributes:
        added: What the user's file holds, as JSON; "" for the built-in words alone.
    """

    verbs: Table
    irregular_verbs: Mapping[str, tuple[str, str]]
    motions: WordSet
    results: Table
    drawer_results: Table
    switches: WordSet
    stands: WordSet
    goes: WordSet
    complete_verbs: WordSet
    relations: Table
    goals: WordSet
    sources: Table
    particles: WordSet
    ways: WordSet
    places: Table
    heights: Table
    parts: Table
    part_synonyms: Table
    parts_by_place: Table
    named_parts: WordSet
    named_with_thing: WordSet
    silent_parts: WordSet
    synonyms: Table
    aliases: Table
    short_names: Table
    containers: WordSet
    hollow: WordSet
    open_supports: WordSet
    surfaces: WordSet
    uncountable: WordSet
    ends_in_s: WordSet
    plurals: Table
    no_things: WordSet
    descriptions: WordSet
    colours: WordSet
    determiners: WordSet
    fillers: WordSet
    numbers: Table
    units: WordSet
    pronouns: Table
    how: WordSet
    ordinals: WordSet
    sides: WordSet
    beside_goals: WordSet
    signs: WordSet
    joints: WordSet
    parting: WordSet
    after: WordSet
    predicates: WordSet
    auxiliaries: WordSet
    modals: WordSet
    telling: WordSet
    question_words: WordSet
    refused: Table
    roles: Table
    articles: WordSet
    fragments: Mapping[str, str]
    spelling: Rules
    courtesies: Patterns
    greetings: Patterns
    headings: Patterns
    constructions: Rules
    added: str = ""

    def match_verb(self, words: Words, at: int, *forms: Form) -> Verb | None:
        """The longest verb phrase that begins at a word, in the first of some forms; "base" if not given."""
        for form in forms or ("base",):
            for length in range(_LONGEST, 0, -1):
                verb = self._verb_phrases.get((form, words[at : at + length]))
                if verb and words[at + length - 1 : at + length + 1] != ("in", "front"):
                    return verb
        return None

    @cached_property
    def _verb_phrases(self) -> dict[tuple[Form, Words], Verb]:
        results = {**self.results, "out": "open"}
        phrases = dict(self.verbs)
        phrases |= {f"{motion} {word}": results[word] for motion in self.motions for word in results}
        phrases = {**dict.fromkeys((*self.motions, *self.switches), HALF_A_VERB), **phrases}
        found: dict[tuple[Form, Words], Verb] = {}
        for phrase, operation in phrases.items():
            word, *more = phrase.split()
            stem = word.removesuffix("e")
            gerund, participle = self.irregular_verbs.get(word, (f"{stem}ing", f"{stem}ed"))
            third = f"{word}es" if word.endswith(("sh", "x", "ch", "ss")) else f"{word}s"
            for form, inflected in zip(FORMS, (word, gerund, participle, third), strict=True):
                found[form, (inflected, *more)] = Verb(operation, word, 1 + len(more))
        return found

    def longest(self, words: Words, at: int, phrases: Table | WordSet) -> str:
        """The longest of some phrases that begins at a word; "" if none does."""
        for n in range(min(_LONGEST, len(words) - at), 0, -1):
            if (phrase := " ".join(words[at : at + n])) in phrases:
                return phrase
        return ""

    def number(self, words: str) -> int:
        """The number that words say from 2 on; 0 if they say none."""
        is_number = words.isdecimal() and len(words) < 3 and int(words) > 1
        return int(words) if is_number else int(self.numbers.get(words, 0))

    def is_position(self, word: str) -> bool:
        """Whether a word says a place or a height."""
        return word in self.places or word in self.heights

    def position(self, word: str) -> str:
        """The place or the height that a word says; the word itself if it says none."""
        return self.places.get(word) or self.heights.get(word) or word

    def singular(self, word: str) -> str:
        """The singular of a noun; the noun itself where it is one already."""
        if word in self.ends_in_s:
            return word
        for ending, other in self.plurals.items():
            if word.endswith(ending):
                return word.removesuffix(ending) + other
        return word[:-1] if word.endswith("s") and not word.endswith(("ss", "us", "is")) else word

    @lru_cache(maxsize=16384)  # noqa: B019  (there are as many lexicons as configurations, so one or two)
    def kind(self, name: str) -> str:
        """The kind of thing that a name stands for: the "wooden cupboard" is a cabinet."""
        return _replace_ending(_replace_ending(name, self.synonyms), self.synonyms)

    @lru_cache(maxsize=16384)  # noqa: B019
    def canonical(self, name: str) -> str:
        """The name that stands for all other names of a thing: "skillet" is the "frying pan"."""
        name = self.kind(name)
        words = _replace_ending(name, self.aliases).split()
        words = [word for word in words if word not in self.descriptions]
        if len(words) > 1 and words[-1] in self.containers and " ".join(words) not in self.aliases.values():
            words.pop()  # "ketchup bottle"
        short = " ".join(words)
        return self.short_names.get(short) or _replace_ending(short, self.aliases) or name

    @cached_property
    def rewrites(self) -> dict[str, list[tuple[re.Pattern[str], str]]]:
        """Compiled rules by step: "spelling", "courtesies", "constructions"; what is "refused", and why."""
        greetings, headings = "|".join(self.greetings), "|".join(self.headings)
        # Before "of" is read as "belonging to", whatever names the memory has.
        names = [(rf"\b{name}\b", other) for name, other in self.synonyms.items() if " of " in name]
        rules = {
            "spelling": self.spelling,
            "courtesies": [
                (rf"\b(?:{'|'.join(self.courtesies)})\b", " "),
                (rf"(?:^|(?<=; ))(?:(?:{greetings})\b[ ,]*)+", ""),
                (rf"(?:^|(?<=; ))(?:{headings})(?: now)? , ", ""),
                (r",? (?:would|will|could|can) you\b|, (?:robot|ok|okay)\b", ""),
            ],
            "constructions": [*((pattern, f" {other} ") for pattern, other in self.constructions), *names],
            "refused": [
                (rf"\b(?:{'|'.join(p for p in self.refused if self.refused[p] == reason)})\b", reason)
                for reason in dict.fromkeys(self.refused.values())
            ],
        }
        lists = {key: "|".join(sorted(getattr(self, key))) for key in ("colours", "surfaces")}
        found: dict[str, list[tuple[re.Pattern[str], str]]] = {step: [] for step in rules}
        for step, pairs in rules.items():
            for pattern, other in pairs:
                for name, fragment in {**self.fragments, **lists}.items():
                    pattern = pattern.replace(f"{{{name}}}", fragment)
                found[step].append((re.compile(pattern), other))
        return found


def _replace_ending(name: str, table: Table) -> str:
    """Replace the longest ending of a name that a table knows: "red cup" -> "red mug"."""
    words = name.split()
    for start in range(len(words)):
        if " ".join(words[start:]) in table.values():
            return name
        if other := table.get(" ".join(words[start:])):
            return " ".join([*words[:start], other])
    return name


def read_lexicon(source: str | None = None) -> Lexicon:
    """The built-in words, with those of a user merged over them.

    Args:
        source: A file of the form of ``lexicon.yaml``, or its contents as JSON, as a checkpoint keeps them;
            None for the built-in words alone.

    Raises:
        LexiconError: The file is missing, or holds an unknown key or what does not belong there.
    """
    text = files("lerobot_openspm.language").joinpath("lexicon.yaml").read_text("utf-8")
    merged = yaml.load(text, Loader=_LOADER)
    if not source:
        return _made(merged, "")
    is_inline = source.lstrip().startswith("{")
    where = "of the checkpoint" if is_inline else source
    try:
        text = source if is_inline else read_text(Path(source), MAX_BYTES)
        # JSON of a checkpoint has no aliases to blow up. YAML scalars are text: "on" is no truth value.
        told = json.loads(text) if is_inline else yaml.load(text, Loader=_LOADER)
    except (OSError, UnicodeDecodeError) as error:
        raise LexiconError(f"lexicon {where} cannot be read: {error}; pass --policy.lexicon=FILE") from error
    except (yaml.YAMLError, json.JSONDecodeError, RecursionError) as error:
        raise LexiconError(f"lexicon {where} is no {'JSON' if is_inline else 'YAML'}: {error}") from error
    told = _checked(told, where)
    merged |= {key: _merged(key, merged[key], value) for key, value in told.items()}
    return _made(merged, json.dumps(told, ensure_ascii=False))


def _merged(key: str, ours: Any, theirs: Any) -> Any:
    if isinstance(ours, list):
        return [*ours, *theirs]
    if _KINDS[key] == "Table":
        given = {word.lower() for words in theirs.values() for word in words}  # has its new meaning alone
        kept = {meaning: [w for w in words if w.lower() not in given] for meaning, words in ours.items()}
        return {meaning: [*kept.get(meaning, ()), *theirs.get(meaning, ())] for meaning in {**kept, **theirs}}
    return {**ours, **theirs}


def _checked(told: Any, where: str) -> dict[str, Any]:
    """What a user's file holds, if it is of the right form: words alone.

    A regular expression that a stranger wrote may never come to an end.
    """
    if not isinstance(told, dict):
        raise LexiconError(f"lexicon {where} is {str(told)[:40]!r}, expected keys such as 'synonyms'")
    for key, value in cast(dict[str, Any], told).items():
        if key not in _KINDS or key in _PATTERNS:
            why = "whose regular expressions are fixed, " if key in _PATTERNS else ""
            allowed = ", ".join(sorted(_KINDS.keys() - _PATTERNS))
            raise LexiconError(f"lexicon {where} has the key {key!r}, {why}expected some of {allowed}")
        expected, form = _FORMS[_KINDS[key]]
        if not _fits(value, form):
            raise LexiconError(f"lexicon {where}, {key}: is {json.dumps(value)[:60]}, expected {expected}")
        if key in _MEANINGS and (odd := [meaning for meaning in value if meaning not in _MEANINGS[key]]):
            raise LexiconError(
                f"lexicon {where}, {key}: has {odd[0]!r}, expected some of {', '.join(_MEANINGS[key])}"
            )
    return cast(dict[str, Any], told)


def _made(told: dict[str, Any], added: str) -> Lexicon:
    made = dict(told)
    for key, value in told.items():
        if _KINDS[key] == "Table":
            made[key] = {word.lower(): meaning for meaning, words in value.items() for word in words}
        elif _KINDS[key] == "WordSet":
            made[key] = frozenset(map(str.lower, value))
        elif _KINDS[key] == "Rules":
            made[key] = tuple((pattern, other) for pattern, other in value)
    return Lexicon(**made, added=added)


def _fits(value: Any, form: Any) -> bool:
    """Whether a value has a form: ``[str]`` is a list of texts, ``(str, str)`` one of just two."""
    if isinstance(form, dict):
        return isinstance(value, dict) and all(_fits(one, form[str]) for one in cast(Any, value).values())
    if isinstance(form, list):
        return isinstance(value, list) and all(_fits(one, form[0]) for one in cast(Any, value))
    if isinstance(form, tuple):
        return _fits(value, [str]) and len(value) == 2
    return isinstance(value, str) and _WORDS.fullmatch(value) is not None


_KINDS = {field.name: str(field.type) for field in fields(Lexicon) if field.name != "added"}
_PATTERNS = {
    "fragments", "spelling", "courtesies", "greetings", "headings", "constructions", "refused",
}  # fmt: skip
# What each kind looks like in a user's file.
_FORMS: dict[str, tuple[str, Any]] = {
    "WordSet": ("a list of words", [str]),
    "Table": ("for each meaning a list of words", {str: [str]}),
    "Mapping[str, tuple[str, str]]": ("for each verb its gerund and its participle", {str: (str, str)}),
}
_WORDS = re.compile(r"[\w '-]+")
ENGLISH = read_lexicon()
