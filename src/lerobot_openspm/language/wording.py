"""The text of an instruction in plain wording: courtesies left out, other constructions made imperatives."""

from __future__ import annotations

import re

from lerobot_openspm.language.constructions import CONSTRUCTIONS
from lerobot_openspm.language.vocabulary import SYNONYMS

_YOU = r"(?:you|the robot|robot|someone|somebody)"
_SPELLING = (
    ("[\u2018\u2019`]", "'"),
    (r"\b(?:can't|cannot)\b", "can not"),
    (r"\bwon't\b", "will not"),
    (r"n't\b", " not"),
    (r"\b(i|you|we|they|it)'d\b", r"\1 would"),
    (r"\b(i|you|we|they)'ve\b", r"\1 have"),
    (r"\b(you|we|they)'re\b", r"\1 are"),
    (r"\b(i|you|we|they|it)'ll\b", r"\1 will"),
    (r"\bi'm\b", "i am"),
    (r"\blet's\b", "let us"),
    (r"\b(that|it|there|here|what|which|who|where|how)'s\b", r"\1 is"),
    (r"s'(?= )", "s 's"),
    (r"'s\b", " 's"),
    (r" [-\u2013\u2014]+ |\u2014", " , "),
    ("[-_\u2013\u2014]", " "),
    (r"[.!?;\n]+", " ; "),
    (r"[,:()]+", " , "),
    (r"&", " and "),
    (r"[^a-z0-9,;' ]+", " "),
    (r"\bstep (?:one|two|three|\d)\b", " ; "),
    (r"'(?!s\b)", " "),
    (r"\s+", " "),
)

# What may be left out wherever it stands.
_COURTESIES = (
    r"(?:if|when|whenever) (?:you (?:would|could|can|may|do not mind|like|please|are ready"
    r"|(?:get|have) (?:a|the) (?:chance|moment|second|minute|time)|have time)|possible|that is ok(?:ay)?)",
    r"please|kindly|thanks(?: a lot)?|thank you(?: very much)?|cheers|for (?:me|us)",
    r"right (?:away|now)|at once|now|immediately|straight away",
    r"carefully|gently|quickly|slowly|safely|neatly|simply|just|softly|completely|fully|firmly|nicely|properly"
    r"|directly|all the way|again|perhaps|maybe|possibly",
    r"(?:(?:do not|never) forget|remember|be sure|make sure|ensure|try|proceed|feel free) to",
    r"(?:make sure|ensure|see to it)(?: that)? you",
    rf"(?:could|can|would|will|might) {_YOU}"
    r"(?: (?:be so (?:kind|good) as to|be able to|mind|go ahead and|go and|help me))?",
    rf"i (?:would|want|need)(?: really)?(?: like| love| prefer)?(?: for)? {_YOU} to",
    r"i (?:would|will) (?:really )?(?:appreciate|love|like|be (?:grateful|happy|glad)) (?:it )?if(?: you)?"
    r"(?: could| would)?",
    r"it would be (?:great|nice|good|helpful|lovely|wonderful) (?:if you (?:could|would)|to)",
    rf"i am going to need {_YOU} to|i will need {_YOU} to|help me(?: out)?(?: to| by)?",
    r"(?:would|is) it (?:be )?(?:possible|ok(?:ay)?)(?: for you)? to|i (?:think|guess|believe|suppose)",
    r"(?:start|begin|finish|end)(?: off| up)? (?:by|with)|in order(?= to)",
    r"(?:you|we|the robot|robot) (?:should|must|(?:will |would )?(?:need to|have to)|ought to"
    r"|are to|can|may|shall)",
    r"(?:your|the|my|our)(?: (?:next|first))? (?:task|job|goal|mission|aim)(?: now)? is to",
    r"(?:do you )?mind(?= \w+ing)|(?:care|like) to|fancy(?= \w+ing)|be a (?:dear|pal) and|thanks in advance",
    r"(?:i was wondering if|i wonder if|any chance|any chance that) you (?:could|would|can)",
    r"do me a favou?r and|(?:what|all) i (?:want|need|would like) is (?:for you )?to|you are (?:to|going to)",
    r"(?:when|once|as soon as|after) (?:you are |that is |it is |you have )?(?:done|finished)(?! \w+ing)",
    r"(?:once|when|after|as soon as) (?:it|that) is (?:in(?:side)?|there|in there|in it|in place)"
    r"(?= ?(?:[,;]|$))",
    r"go ahead and|go and|let us|why do not you|be so (?:kind|good) as to|it is time to|time to",
)
# What may be left out where a sentence begins.
_GREETINGS = r"(?:hey|hi|hello|ok|okay|alright|all right|so|well|robot|assistant|yes|right|excuse me)"

_HEADINGS = r"(?:(?:your|next|new|the|first) )?(?:task|goal|job|instruction|command|request|order|thing)"


def plain_words(text: str) -> str:
    """Lower-case words with "," and ";" between clauses and sentences, without courtesies."""
    text = text.lower()
    if re.match(r"\s*\(?1[.):]", text):  # "1. open the drawer 2. put the bowl in it", but not "block 1."
        text = re.sub(r"(?:^|\s)\(?\d[.):]\s+", " ; ", text)
    for pattern, replacement in _SPELLING:
        text = re.sub(pattern, replacement, text)
    text = _collapse(text)
    text = _collapse(re.sub(rf"\b(?:{'|'.join(_COURTESIES)})\b", " ", text))
    text = _collapse(re.sub(rf"(?:^|(?<=; ))(?:{_GREETINGS}\b[ ,]*)+", "", text))
    text = _collapse(re.sub(rf"(?:^|(?<=; ))(?:{_HEADINGS})(?: now)? , ", "", text))
    return _collapse(re.sub(r",? (?:would|will|could|can) you\b|, (?:robot|ok|okay)\b", "", text))


def plain_wording(text: str) -> str:
    """Plain words with other constructions rewritten, and the marks above."""
    text = plain_words(text)
    for pattern, replacement in CONSTRUCTIONS:
        text = _collapse(re.sub(pattern, f" {replacement} ", text))
    for name, other in SYNONYMS.items():
        if " of " in name:  # before "of" is read as "belonging to", whatever names the memory has
            text = re.sub(rf"\b{name}\b", other, text)
    return text


def _collapse(text: str) -> str:
    text = re.sub(r"\s+", " ", text)
    text = re.sub(r"(?: ?,)+(?= ?[,;]|$)|(?<=;)(?: ?,)+", "", text.strip())
    return re.sub(r"(?:; ?)+(?=;)|^[ ,;]+|[ ,;]+$", "", text).strip()
