"""Whether two names mean the same thing: by the table of words, or by embeddings of a static text model."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.language.lexicon import ENGLISH, Lexicon

# Another word for it ("cup" for "mug"); fewer words ("bottle" for "wine bottle"); more that say little
# ("small bowl") or are usual; more that may well say that another thing is meant ("soup bowl", "blue bowl").
ALIAS, LESS_SAID, MORE_SAID, OTHER_KIND = 0.99, 0.96, 0.85, 0.7
# Cosine of two embeddings from which on they are taken for the same thing.
MIN_COSINE = 0.6


class NameSimilarity(Protocol):
    """How sure it is that a name in an instruction means a thing that the memory knows."""

    @property
    def lexicon(self) -> Lexicon:
        """The words that instructions are read by."""
        ...

    def similarity(self, asked: str, known: str) -> float:
        """0 (another thing) to 1 (the same words)."""
        ...


@dataclass(frozen=True)
class TableNames:
    """Names by the lexicon's tables alone."""

    lexicon: Lexicon = ENGLISH

    def similarity(self, asked: str, known: str) -> float:
        """See :class:`NameSimilarity`."""
        if asked == known:
            return 1.0
        if not asked or not known:
            return 0.0
        a, k = self.lexicon.canonical(asked), self.lexicon.canonical(known)
        if a == k:
            return MORE_SAID if set(asked.split()) & self.lexicon.descriptions else ALIAS
        return max(_shared_words(self.lexicon, asked, known), _shared_words(self.lexicon, a, k))


def _shared_words(lex: Lexicon, asked: str, known: str) -> float:
    """How alike two names of one head are, one of which says more than the other: "bottle", "wine bottle"."""
    a, k = asked.split(), known.split()
    if a[-1] != k[-1] or _colours_differ(lex, asked, known):
        return 0.0
    if set(a) <= set(k):
        return LESS_SAID
    if not set(k) <= set(a):
        return 0.0
    return MORE_SAID if asked in lex.aliases.values() else OTHER_KIND  # "wine bottle" for "bottle"


def _is_shorter(lex: Lexicon, asked: str, known: str) -> bool:
    """Whether one name is the other with words left out: "bowl", "black bowl"; "milk", "milk carton"."""
    a, k = asked.split(), known.split()
    if a and k and k[-1] in lex.containers and a == k[:-1]:
        return True
    return bool(a and k) and a[-1] == k[-1] and set(a) < set(k)


def _colours_differ(lex: Lexicon, a: str, b: str) -> bool:
    """Whether both names say a colour, and not the same."""
    colours_a, colours_b = set(a.split()) & lex.colours, set(b.split()) & lex.colours
    return bool(colours_a) and bool(colours_b) and colours_a != colours_b


TABLE_NAMES = TableNames()


class AmongKnown:
    """A similarity that never merges what the memory holds apart.

    A name that the memory has means that thing, or one that it is a shorter name of ("bowl" for "black
    bowl"), and no other: where cups and mugs are known, who asks for the cup does not mean the mug. Of the
    other names, those that the table finds somewhere in the memory mean nothing else: who asks for the milk
    does not mean the butter, however alike embeddings find the two.

    Args:
        names: The similarity of names that are not known.
        known: All names in the memory.
    """

    def __init__(self, names: NameSimilarity, known: Collection[str]):
        self._names = names
        self.lexicon = names.lexicon
        self._table = TableNames(names.lexicon)
        self._known = known
        self._in_table: dict[str, bool] = {}

    def similarity(self, asked: str, known: str) -> float:
        """See :class:`NameSimilarity`."""
        if asked in self._known:
            return 1.0 if asked == known else _is_shorter(self.lexicon, asked, known) * LESS_SAID
        if asked not in self._in_table:
            self._in_table[asked] = any(self._table.similarity(asked, name) > 0 for name in self._known)
        names = self._table if self._in_table[asked] else self._names
        return names.similarity(asked, known)


class Model2VecNames:
    """The table, and where it knows no better the cosine of static embeddings (model2vec).

    Args:
        weights: Folder with a model2vec model, or its name on the Hub.
        lexicon: The words that are known without it.
        min_cosine: Cosine from which on two names are taken for one thing.

    Raises:
        InstructionError: The package or the weights are missing.
    """

    def __init__(self, weights: str, lexicon: Lexicon = ENGLISH, min_cosine: float = MIN_COSINE):
        try:
            from model2vec import StaticModel
        except ImportError as error:
            raise InstructionError(
                "name_embeddings needs the package model2vec, which is not installed; install it with: "
                "pip install 'lerobot_policy_openspm[text]'"
            ) from error
        try:
            self._model: Any = StaticModel.from_pretrained(weights)
        except Exception as error:  # the Hub, the file system and the format each have their own
            kind = (
                "in that folder"
                if Path(weights).is_dir()
                else "there, neither a folder nor a name on the Hub"
            )
            raise InstructionError(
                f"name_embeddings is {weights!r}, but no model2vec model could be read {kind} "
                f"({type(error).__name__}: {error}); fetch one with: "
                "hf download minishlab/potion-base-8M --local-dir FOLDER, and pass "
                "--policy.name_embeddings=FOLDER"
            ) from error
        self.lexicon = lexicon
        self._table = TableNames(lexicon)
        self._min_cosine = min_cosine
        self._embedded: dict[str, Array] = {}

    def similarity(self, asked: str, known: str) -> float:
        """See :class:`NameSimilarity`; a name that embeddings alone recognise counts less than any other."""
        by_table = self._table.similarity(asked, known)
        if by_table > 0 or not asked or not known or _colours_differ(self.lexicon, asked, known):
            return by_table
        a, k = self._embed(asked), self._embed(known)
        norms = float(np.linalg.norm(a) * np.linalg.norm(k))
        cosine = float(a @ k) / norms if norms > 0 else 0.0
        if cosine < self._min_cosine:
            return 0.0
        return MORE_SAID + (ALIAS - MORE_SAID) * (min(cosine, 1.0) - self._min_cosine) / (
            1 - self._min_cosine
        )

    def _embed(self, name: str) -> Array:
        if name not in self._embedded:
            self._embedded[name] = np.asarray(self._model.encode(name), float)
        return self._embedded[name]


def names_from(weights: str | None, lexicon: Lexicon = ENGLISH) -> NameSimilarity:
    """The lexicon's tables, or with a model2vec model beside them. Raises InstructionError, as that does."""
    return TableNames(lexicon) if weights is None else Model2VecNames(weights, lexicon)
