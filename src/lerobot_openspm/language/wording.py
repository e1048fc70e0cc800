"""The text of an instruction in plain wording: courtesies left out, other constructions made imperatives."""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache

from lerobot_openspm.language.lexicon import Lexicon


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
    """Plain words with other constructions rewritten, and the marks of :mod:`phrases`."""
    return _rewritten(lex, "constructions", plain_words(lex, text))


def _rewritten(lex: Lexicon, step: str, text: str) -> str:
    for pattern, other in lex.rewrites[step]:
        text = _collapsed(pattern.sub(other, text))
    return text


def _collapsed(text: str) -> str:
    text = re.sub(r"\s+", " ", text)
    text = re.sub(r"(?: ?,)+(?= ?[,;]|$)|(?<=;)(?: ?,)+", "", text.strip())
    return re.sub(r"(?:; ?)+(?=;)|^[ ,;]+|[ ,;]+$", "", text).strip()
