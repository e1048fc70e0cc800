"""The words of an instruction as elements of the task, wherever they stand: things, prepositions, cues."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language import vocabulary as v
from lerobot_openspm.language.nouns import Noun, read_noun
from lerobot_openspm.language.prepositions import Preposition, match_preposition

Kind = Literal["noun", "preposition", "operation", "result", "joint", "copula", "wish", "relative", "filler"]

# Things of the table and the kitchen, besides those that have other names in the vocabulary.
THINGS = v.word_set(
    "milk butter ketchup bowl plate ramekin stove basket cabinet shelf microwave caddy tray book mug desk "
    "floor pot rack"
) | {
    "alphabet soup", "tomato sauce", "cream cheese", "cream cheese box", "cookie box", "salad dressing",
    "orange juice", "chocolate pudding", "bbq sauce", "wine bottle", "frying pan", "moka pot", "rack",
    "milk carton", "ketchup bottle", "butter stick", "cabinet shelf", "book caddy",
    *v.ALIASES, *v.ALIASES.values(), *v.SYNONYMS, *v.SYNONYMS.values(), *v.SHORT_NAMES,
}  # fmt: skip

_RESULTS = {
    **v.RESULTS, "opened": "open", "opening": "open", "closing": "close", "lit": "turn on",
    "burning": "turn on", "running": "turn on",
}  # fmt: skip
_WISHES = v.word_set(
    "should must needs need ought goes go belongs belong has have want wants wanted needed meant "
    "supposed shall let prefer fancy wish would could makes see ends end lands land"
)
_COPULAS = v.word_set("is are was were")
FORMS = ("base", "gerund", "participle", "third")
_RELATIVES = (
    "that is|which is|that are|that sits|that stands|that lies|which sits|which stands|which lies"
    "|the one|that one|there is|there are|you find|you see|will find|i see"
)
_STANDING = v.word_set(
    "sitting standing lying resting located placed found positioned kept sits stands lies rests"
)
_JOINTS = {
    ";": ";", ",": ",", "and": "and", "then": "then", "after": "after", "once": "after", "when": "after",
    "having": "after", "before": "before", "so": ",", "but": ",", "afterwards": "last", "afterward": "last",
    "later": "last", "finally": "then", "next": "then", "first": "first", "beforehand": "first",
    "firstly": ",", "second": "then", "with": ",",
}  # fmt: skip
# Words that say nothing of what is to be done to what.
_FILLERS = v.word_set(
    "i we you he it's me my your us am be been being to of for as well too also up down over back there here "
    "the a an that this these those its way find finds found using gripper hand arm time get gets still "
    "currently at point up's do does done doing will can may might both all one ones together along away now "
    "thing things item items object objects something place places spot home position stay stand sit rest "
    "come comes put inside mean like love would glad happy where which who in on 's by from same just only "
    "right good sits stands lies rests better please piece such move moved kind straight already order ready "
    "new proper usual going robot sure make which's need's lid quick careful little bit gentle light small"
) - v.word_set("on in off only already found by from light inside into onto")
_SIDE = r"left|right|front|back|middle|cent(?:re|er)|rear"
_SPOT = r"(?:area|space|gap|spot|place|region|position|home)"
_SAID_AGAIN = (
    (r"\b(?:what|all) (?:i|we) (?:(?:would|really|want|need|like|love|prefer) )+is (?:for )?", "must "),
    (r"(?:^|(?<=; ))(?:see|notice|spot|look at) (?=(?:the|that|a)\b)", "there is "),
    (r"\b(?:go|head|walk|reach)(?: over)? (?:to|for) (the [a-z]+(?: [a-z]+)?) and ", r"\1 , "),
    (r"\bsee to it that\b", "must"),
    (r"\bafter (?:that|which|this)\b(?! \w+ing)", "then"),
    (r"\band that the\b", "and the"),
    (r"\bfirst of all\b|\bup top ,", ""),
    (r"\b(fire|power|light|start|turn|switch) (the \w+|it) (up|on|off)\b", r"\1 \3 \2"),
    (r"\b(?:flame|heat|gas|fire|burner) (?:on|of|under) the stove\b", "stove"),
    (r"\b(?:box|package|packet|pack)s? of (?:the )?(?:cookies?|biscuits?)\b", "cookie box"),
    (r"\bbottle of wine\b", "wine bottle"),
    (rf"\b(?:{'|'.join(sorted(v.CONTAINERS - {'block'}))})s? of (?:the )?(?=[a-z])", ""),
    (rf"\b(?:(?:in|to|into|on|onto|at) )?(?:the|a) {_SPOT}(?: (?:right|just|directly))? "
     r"(?=in front|between|next|beside|under|on|left|right|behind|to the)", ""),
    (r"\b(?:along|across|over) the (?:table|counter|desk)(?: top)?\b", ""),
    (rf"'s (?:new |right |proper |usual )?{_SPOT} is (?=in\b|on\b|at\b|to\b|under|next|beside|inside|behind)",
     "goes"),
    (rf"'s (?:new |right |proper |usual )?{_SPOT} is\b", "goes to"),
    (r"(the [a-z ]+?) (?:should|must|needs to|has to) (?:have|hold|get|receive) (the [a-z ]+?) "
     r"(?:on|in|inside) it\b", r"put \2 to \1"),
    (r"(?<!to )(?<!on )(?<!at )(?<!from )the (\w+most|left|right|middle|front|back|rear)(?: one)? of "
     r"(?:the )?(?:two |three |both )?((?:[a-z]+ )?[a-z]+)s\b", r"the \1 \2"),
    (r"\b(that|those) ((?:\w+ )?\w+) there\b", r"\1 \2"),
    (r"\bon (?:the )?(cabinet|stove) top\b", r"on top of the \1"),
    (r"\bthe one (?:to (?:put|place|set|go) )(?=on|in|under)", "must go "),
    (r"\bto where (the (?:front|left|right) of the \w+) is\b", r"to \1"),
    (r"\b(?:(?:the|these|those|both|all) )?(?:two|three|following|these|those|both) "
     r"(?:things|items|objects)\b", ""),
    (r"(?<!in )(?<!on )(?<!to )(?<!of )(?<!into )(?<!onto )(?<!under )(?<!inside )"
     r"\b(the [a-z' ]+?) is where (the [a-z ]+?) (?:should|must|has to|needs to|ought to|goes|belongs)"
     r"(?: (?:be|go|stand|sit|end up))?(?= ?(?:[,;]|$))", r"put \2 to \1"),
    (r"(?:that is|that) where\b|\bis where\b", "goes"),
    (r"\bhas to\b|\bhave to\b|\b(?:is|are)(?: both| all)? (?:to|supposed to|meant to)\b", "must"),
    (r"\b(?:is|are) (needed|wanted|meant)\b", r"\1"),
    (r"\b(?:needed|wanted|meant) for\b", "should go to"),
    (r"\b(?:makes it|finds its way|find its way|gets|get)(?= (?:in)?to\b)", "goes"),
    (r"\b(left|right|front|back) most\b|\b(left|right) hand\b", r"\1\2"),
    (r"\b(?:furthest|farthest|closest|nearest)(?: to)?(?: the)? (left|right|front|back)\b", r"at the \1"),
    (r"(?<!the )(?<!to )\b(left|right) of\b", r"to the \1 of"),
    (rf"\b(to|at|on|in) (?:the )?((?:\w+ )?\w+) 's ({_SIDE})(?: side)?(?= ?(?:[,;]|$|by|and))",
     r"\1 the \3 of the \2"),
    (r"\b(?:give )?(?:a|another) (?:gentle |little |small |light |quick )*(nudge|push|shove) to (?=the)",
     r"\1 "),
    (r"\bby (?=\w+ing\b)", ", "),
    (r"\bto (?=under|below|beneath|beside|in front|inside|on top|next to|the top of)", ""),
    (r"\b(?:see|attend) to (?:that|it|this)\b|\bsee that\b|\bwith (?:it|them)\b|\bi mean\b", ""),
    (r"\bover (?=the (?:basket|tray))", "into "),
)  # fmt: skip
_HERE = re.compile(
    rf"(?:in|at|on|to) (?:the )?(?:far |very )?({_SIDE})(?: side)?"
    r"(?= (?:be|must|should|has|have|need|needs|goes|go|is|belongs|ought|of the two)\b)"
)


@dataclass(frozen=True)
class Element:
    """A word or phrase and what it is.

    Attributes:
        kind: What it is.
        words: Its words.
        value: An operation, or the kind of a joint.
        noun: Of a noun.
        preposition: Of a preposition.
    """

    kind: Kind
    words: str
    value: str = ""
    noun: Noun | None = None
    preposition: Preposition | None = None


def said_again(text: str) -> str:
    """A text in plain words, with fewer ways to say a thing."""
    for pattern, other in _SAID_AGAIN:
        text = " ".join(re.sub(pattern, f" {other} ", text).split())
    return text


def read_elements(text: str, things: Collection[str] = THINGS) -> list[Element]:
    """Find the elements of a text as :func:`said_again` gives it.

    Raises:
        InstructionError: There is a word that is none of them.
    """
    words = tuple(text.split())
    noun_at = _noun_pattern(frozenset(things))
    found: list[Element] = []
    i = 0
    while i < len(words):
        element = _element(words, i, noun_at, found)
        if element is None:
            raise InstructionError(f"has a word I do not know: {words[i]!r}")
        found.append(element)
        i += len(element.words.split())
    return found


@lru_cache(maxsize=8)
def _noun_pattern(things: frozenset[str]) -> re.Pattern[str]:
    """Noun phrases: determiners, attributes, a thing or a part of it; pronouns."""
    said = v.word_set("same other entire whole single little said") | (v.DESCRIPTIONS - {"open", "closed"})
    colour = "|".join(v.COLOURS)
    height = f"(?:{'|'.join({**v.PLACES, **v.HEIGHTS})})"
    before = rf"(?:(?:{'|'.join(v.DETERMINERS | said)}|{height}|{'|'.join(v.NUMBERS)}|all|each|of the|of) )*"
    colours = rf"(?:(?:{colour}) (?:and (?={colour}))?)*"
    thing = "|".join(sorted(map(re.escape, things), key=len, reverse=True))
    thing = rf"{before}{colours}(?:{thing})(?:e?s)?"
    part = "|".join((*v.PART_OF, *v.NAMED_PARTS, "layer", "tier", "section", "slot", "pocket"))
    where = rf"{before}(?:{part})s?"
    phrases = (
        rf"{thing} 's (?:{height} )*(?:{part})",
        rf"{where} of {thing}",
        rf"{thing} (?:{height} )*(?:{part})",
        thing, where, rf"{before}{colours}one", r"(?:both|all|each|two) of (?:them|these|those)",
        "it|them|those|these|they|itself|both|that|this|there",
    )  # fmt: skip
    return re.compile(rf"(?:{'|'.join(phrases)})(?= |$)")


def _element(
    words: tuple[str, ...], i: int, noun_at: re.Pattern[str], found: list[Element]
) -> Element | None:
    rest = " ".join(words[i:])
    if match := re.match(rf"(?:{_RELATIVES})(?: (?:{'|'.join(_STANDING)}))?(?= |$)", rest):
        after = rest[match.end() :].strip().split()
        is_done_to = bool(found) and found[-1].kind == "operation"  # "move that one onto the plate"
        if (not is_done_to and match_preposition(tuple(after), 0)) or match[0].startswith(
            ("there", "you", "will", "i ")
        ):
            return Element("relative", match[0])
    if words[i] in _STANDING and match_preposition(words, i + 1) and found and _is_name(found[-1]):
        return Element("relative", words[i])
    if match := _HERE.match(rest):
        return Element("preposition", match[0], preposition=Preposition("", v.PLACES[match[1]]))
    preposition = match_preposition(words, i)
    verb = next((x for form in FORMS if (x := v.match_verb(words, i, form))), None)
    if verb is not None and verb.word in v.OF_WHAT_IS_HELD:
        raise InstructionError(f"says to {verb.word} something as it is")
    if verb is not None and verb.length > 1 and words[i + 1] in ("on", "off"):
        return Element("operation", " ".join(words[i : i + verb.length]), verb.operation)
    if words[i] in ("on", "off") and _is_result(words, i):
        return Element("result", words[i], f"turn {words[i]}")
    noun = noun_at.match(rest)
    if words[i] == "there" and match_preposition(words, i + 1):
        return Element("filler", "there")
    if preposition and not (noun and words[i] in v.PARTICLES and " " in noun[0]):
        return Element("preposition", " ".join(words[i : i + preposition.length]), preposition=preposition)
    if noun:
        return Element("noun", noun[0], noun=_noun(noun[0]))
    if words[i] in _RESULTS and (words[i] != "open" or (found and found[-1].kind in ("noun", "copula"))):
        return Element("result", words[i], _RESULTS[words[i]])
    if words[i] in _JOINTS:
        return Element("joint", words[i], _JOINTS[words[i]])
    if words[i] in _COPULAS:
        return Element("copula", words[i])
    if words[i] in ("has", "have", "had") and words[i + 1 : i + 2] == ("been",):
        return Element("copula", words[i])
    if words[i] in _WISHES:
        return Element("wish", words[i])
    if verb is not None:
        return Element("operation", " ".join(words[i : i + verb.length]), verb.operation)
    return Element("filler", words[i]) if words[i] in _FILLERS or words[i] in v.PARTICLES else None


def _is_name(element: Element) -> bool:
    return element.noun is not None and not element.noun.pronoun


def _is_result(words: tuple[str, ...], i: int) -> bool:
    after = words[i + 1] if i + 1 < len(words) else ""
    return after in ("", ",", ";", "and", "then", "at", "now", "before", "first", "second", "after", "once")


def _noun(words: str) -> Noun:
    if words in ("that", "this") or "of them" in words or "of these" in words or "of those" in words:
        return Noun(pronoun="it" if words in ("that", "this") else "them")
    noun = read_noun(tuple(words.removeprefix("of ").split()))
    is_one = words.startswith("of ") or (words.startswith("both ") and not words.endswith("s"))
    return replace(noun, count=1) if is_one else noun  # "of the bowls, the left one", "both the milk and"
