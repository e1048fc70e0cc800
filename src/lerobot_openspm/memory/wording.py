"""The text of an instruction in plain wording: courtesies left out, other constructions made imperatives."""

from __future__ import annotations

import re

from lerobot_openspm.memory.vocabulary import COLOURS, SYNONYMS

# Marks for what a rewritten phrase meant. "I'd like the soup in the basket" needs no verb; "you see the bowl
# by the plate?" says what is spoken of; "that is on the stove" belongs to the noun before it; "do the same
# with the butter" repeats a clause.
WANTED, SEEN, WHICH, SAME = "@wanted", "@seen", "@which", "@same"

_YOU = r"(?:you|the robot|robot|someone|somebody)"
# A few words of one clause.
_THING = r"(?:(?!\b(?:and|then)\b)[^,;])+?"
_COLOUR = "|".join(sorted(COLOURS))
_THINGS = r"[^,;]+?"
_END = r"(?=\s*(?:[,;]|$))"

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
    ("[-_\u2013\u2014]", " "),
    (r"[.!?;\n]+", " ; "),
    (r"[,:()]+", " , "),
    (r"&", " and "),
    (r"[^a-z0-9,;' ]+", " "),
    (r"\bstep (?:one|two|three|\d)\b|\b\d\b", " ; "),
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
    r"(?:you|we|the robot|robot) (?:should|must|need to|have to|ought to|are to|can|may|shall)",
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

# Other constructions of what an imperative says.
_CONSTRUCTIONS = (
    (rf"\b({_THING}) is where (?:i|we) (?:want|need|would like) ({_THING}){_END}", r"put \2 to \1"),
    (rf"\b({_THING}) is where ({_THING}) (?:(?:should|needs? to|must|ha(?:s|ve) to) (?:go|be)|goes?|belongs?)"
     rf"{_END}", r"put \2 to \1"),
    (r"\b(?:what|all) (?:i|we) (?:want|need|would like) is\b", WANTED),
    (r"\bto (?:the )?(on|off)(?: position| setting)?\b(?= ?(?:[,;]|$|and|then))", r"\1"),
    (r" , (?:the|that) one(?= (?:on|in|at|next|between|by|from|near|beside|to)\b)", f" {WHICH}"),
    (r"\bfrom where it (?:is|sits|stands|lies|rests)\b", "from"),
    (r"\b(?:i|we) (?:would|want|need|wish)(?: really)?(?: like| love| prefer)?(?: to (?:have|see|get))?\b",
     WANTED),
    # "have the bowl placed on the plate", "make sure the drawer is open", "could we have the milk here"
    (r"\b(?:make sure|ensure|see to it|make certain)(?: that)?\b"
     r"|(?:^|(?<=[;,]) )(?:have|let|make)\b(?= (?:the|that|a)\b)"
     r"|\b(?:could|can|may) (?:i|we) (?:have|get)\b", WANTED),
    (rf"\b({_THING}) (?:gets|receives|(?:should|must|needs to|has to) (?:hold|have|contain|get|receive))"
     rf" ((?:the|a|both) {_THINGS})(?: (?:on|in) it)?{_END}", r"put \2 to \1"),
    (rf"\b(?:fill|load|pack) ({_THING}) with ({_THINGS}){_END}", r"put \2 in \1"),
    (rf"\bwith ({_THING}) (open|on|off|closed|shut) ,", r"once \1 is \2 ,"),
    (rf"\bmove ({_THING}) by (push|slid)ing it\b", r"push \1"),
    (rf"\bget ({_THING}) (?:going|started|running|lit)\b", r"turn on \1"),
    (rf"\breach (?:in|into|inside) ({_THING})(?: (?:and|,))+ (grab|get|take|pick up|fetch|retrieve|remove)"
     r" ((?:the|that|a) \w+(?: \w+)??)(?= (?:and|then|from)\b| ?[,;]|$)", r"\2 \3 from \1"),
    (r"\b(grab|get|bring|fetch|hand|find) me\b", r"\1"),
    (r"\b(?:to|on|at) its (left|right|front|back)(?: hand)?(?: side)?\b", r"to the \1 of it"),
    (r"\b(?:on|onto|to) the (?:very )?top (?:surface |side |part )?of\b", "on top of"),
    (rf"\bgive ({_THING}) an? (?:(?:little|gentle|small|light|good) )?(push|nudge|shove)\b", r"\2 \1"),
    (r"\b(?:so that|so|until) (?:it|they) (?:ends? up|is|are|sits?|lands?|comes? to rest|stands?|rests?)\b",
     ""),
    (r"\b(?:do|does|did) the same (?:with|for|to)\b|\b(?:and )?so (?:does|do|should|must)\b", f", {SAME}"),
    (rf"\band (?:then )?the other(?: one)?(?: too| as well)?{_END}", f", {SAME} the other"),
    (rf"\band ((?:the|that|a) {_THING})(?: ,)? (?:too|as well|also|likewise){_END}", rf", {SAME} \1"),
    (rf" (?:too|as well|also|likewise){_END}", ""),
    (r" , both of (?:them|these)\b(?: ,)?", ""),
    (r"\b(?:furthest|farthest|nearest|closest)(?: to)?(?: the)? (left|right|front|back)\b", r"at the \1"),
    (r" , which (should|must|needs to)(?: then)?\b", r" ; it \1"),
    (rf"\bget ({_THING} (?:turned|switched|opened|closed|shut|put|placed|set|moved)\b)", rf"{WANTED} \1"),
    (r"\b(?:along with|together with|as well as|plus|and also|and then)"
     r" ((?:the|that) \w+(?: (?!in\b|on\b|into\b|onto\b|to\b|is\b|goes\b)\w+){0,3})(?=\s*(?:;|$))",
     rf", {SAME} \1"),
    (r"\b(?:as well as|along with|together with|plus)\b", "and"),
    (r"\b(?:do )?you (?:can |will )?(?:see|find)\b|\bthere (?:is|are)\b|\bnotice\b|\bas for\b"
     r"|(?:^|(?<=; ))(?:see|look at|i (?:can )?see)\b", SEEN),
    # "the bowl that is standing on ...", "the bowl you see on ...", "the bowl lying on ..."
    (rf"(?:\b(?:that|which)\b|{SEEN})(?: (?:is|are|was|were|currently|sitting|standing|lying|resting|located"
     r"|placed|found|positioned|kept|sits?|stands?|lies?|rests?|sandwiched|nestled|perched|balanced|situated"
     r"|stored|sat|seated|tucked|hiding))+\b|(?<!and )(?<!be )(?<!been )\b(?:currently|sitting|standing|lying"
     r"|resting|located|positioned|sandwiched|nestled|situated|perched|stored)\b", WHICH),
    (rf"(\w+) {WHICH} ((?:{_COLOUR})(?: and (?:{_COLOUR}))*)\b", r"\2 \1"),
    (r"\bfrom (?:its|their) (?:usual |current )?(?:place|spot|position)\b(?= \w)", "from"),
    (r"\b(?:in|to|into|at) (?:its|their) (?:usual |right )?(?:place|spot|position|home)\b(?= \w)", ""),
    # "to the stove's front side", "from the wooden cabinet's left"
    (r"\b(to|at|on|onto|from) (?:the )?([a-z]+(?: [a-z]+)?) 's (left|right|front|back|rear|top)(?: hand)?"
     rf"(?: side| edge)?{_END}",
     r"\1 the \3 of the \2"),
    (rf"\b(?:on|onto|to) the (\w+) top{_END}", r"on top of the \1"),
)  # fmt: skip


def plain_wording(text: str) -> str:
    """Lower-case words with "," and ";" between clauses and sentences, and the marks above."""
    text = text.lower()
    for pattern, replacement in _SPELLING:
        text = re.sub(pattern, replacement, text)
    text = _collapse(text)
    text = _collapse(re.sub(rf"\b(?:{'|'.join(_COURTESIES)})\b", " ", text))
    text = _collapse(re.sub(rf"(?:^|(?<=; ))(?:{_GREETINGS}\b[ ,]*)+", "", text))
    text = _collapse(re.sub(rf"(?:^|(?<=; ))(?:{_HEADINGS})(?: now)? , ", "", text))
    text = _collapse(re.sub(r",? (?:would|will|could|can) you\b|, (?:robot|ok|okay)\b", "", text))
    for pattern, replacement in _CONSTRUCTIONS:
        text = _collapse(re.sub(pattern, f" {replacement} ", text))
    for name, other in SYNONYMS.items():
        if " of " in name:  # before "of" is read as "belonging to"
            text = re.sub(rf"\b{name}\b", other, text)
    return text


def _collapse(text: str) -> str:
    text = re.sub(r"\s+", " ", text)
    text = re.sub(r"(?: ?,)+(?= ?[,;]|$)|(?<=;)(?: ?,)+", "", text.strip())
    return re.sub(r"(?:; ?)+(?=;)|^[ ,;]+|[ ,;]+$", "", text).strip()
