"""Other constructions of what an imperative says, as patterns and what they are rewritten to."""

from __future__ import annotations

from lerobot_openspm.language.vocabulary import COLOURS

# Marks for what a rewritten phrase meant. "I'd like the soup in the basket" needs no verb; "you see the bowl
# by the plate?" says what is spoken of; "that is on the stove" belongs to the noun before it; "do the same
# with the butter" repeats a clause.
WANTED, SEEN, WHICH, SAME = "@wanted", "@seen", "@which", "@same"

# A few words of one clause.
_THING = r"(?:(?!\b(?:and|then)\b)[^,;])+?"
_COLOUR = "|".join(sorted(COLOURS))
_THINGS = r"[^,;]+?"
_END = r"(?=\s*(?:[,;]|$))"
_NOUN = r"(?:the|that|this|a|an|both|each) (?:(?!\b(?:and|then|there)\b)[a-z']+ ){0,4}?[a-z]+"
_NOUNS = r"(?:the|that|this|a|an|both|two) [^,;]+?"
_BEGIN = r"(?:^|(?<=; ))"
_UP = r"(?:up|down|over|back|straight|right)"
_PREPOSITION = r"(?:on top of|onto|into|inside|on|in|under|underneath|below|next to|beside|behind|between)"
_SPOT = r"(?:spot|place|room|space|home)"
_CADDY = r"(?:desk )?(?:caddy|organi[sz]er)"
_CELL = r"(?:compartment|section|slot|pocket|part)"
_BOTH = (
    r"(?:both(?: of (?:them|these|those))?|these two|those two|the two|the following|two)"
    r"(?: things| items| objects)?"
)
_MAKES = r"open|close|shut|(?:turn|switch) (?:on|off)|turn"

# "Into the basket with the soup", "the soup's place is in the basket": where something goes, without a verb.
_PLACES = (
    (
        rf"{_BEGIN}((?:{_UP} )*{_PREPOSITION} {_THING}) with ({_NOUNS})(?=\s*(?:[,;]|$|and then\b|then\b))",
        r"put \2 \1",
    ),
    (
        rf"\b({_PREPOSITION} {_THING}) is where (?:i|we) (?:want|need|would like) ({_THING}){_END}",
        r"put \2 \1",
    ),
    (
        rf"\b({_PREPOSITION} {_THING}) is where ({_THING})"
        rf" (?:(?:should|needs? to|must) (?:go|be)|goes?|belongs?){_END}",
        r"put \2 \1",
    ),
    (
        rf"\b(?:find|make|clear) (?:a |some )?{_SPOT} ({_PREPOSITION} {_THING}) for ({_THINGS}){_END}",
        r"put \2 \1",
    ),
    (rf"\b(?:find|make) (?:a |some )?{_SPOT} for ({_THING}) (?={_PREPOSITION}\b)", r"put \1 "),
    (rf"\b(?:the|a) (?:right |proper |best )?{_SPOT} for ({_THING}) is (?={_PREPOSITION}\b)", r"put \1 "),
    (rf"\b(?:the|a) (?:right |proper |best )?{_SPOT} for ({_THING}) is (?=the\b)", r"put \1 to "),
    (rf"({_THING}) 's (?:right |proper )?{_SPOT} is (?={_PREPOSITION}\b)", r"\1 belongs "),
    (rf"{_BEGIN}it is ({_THING}) that (?=should|goes|needs|must|has|belongs)", r"\1 "),
    (rf"\b({_THING}) (?:needs|wants) ({_NOUNS}) (?:on|in|inside) it{_END}", r"put \2 to \1"),
    (r"(?<!\bi )(?<!we )(?<!you )\bwants (?=to be\b|to go\b|\w+ing\b)", "needs "),
    (r"\blives (?=on|in|inside|under|next)", "belongs "),
    (
        rf"\b(it|them|that|{_NOUN})(?<!\bin)(?<!\bon)"
        rf"(?<!inside)(?<!under)(?<!\bup)(?<!over)(?<!down) there{_END}",
        r"\1 to there",
    ),
    (rf"\bthere (?={_PREPOSITION}\b)", ""),
    (r"\b(?:up and over|up and|over and) (?=on|in|over)", "up "),
    (r"\bup top of\b", "on top of"),
    (r"\bfrom the top of\b", "from on top of"),
    (r"\b(?:that|which) (?:you|we) (?:will |can )?(?:find|see)\b", "that is"),
    (r"\bdrop (it|them) off (?=in|on|at)", r"drop \1 "),
    (r"\bmaking sure (?:to|you) (close|open|shut)\b", r"and then \1"),
    (rf"\b(door|drawer) after (?:it|that){_END}", r"\1"),
    (r"\bin the (?:space|gap|spot|area|middle) between\b", "between"),
    (
        rf"\b(?:in|into|inside) the ({_CADDY}) , (?:in|into|at|on|to) the (?:{_CELL} (?:at|in|on) the )?"
        rf"(back|front|left|right|rear)(?: hand)?(?: {_CELL}| side)?{_END}",
        r"in the \2 compartment of the \1",
    ),
)
# "Both of them, the soup and the sauce, in the basket": what is counted first and named after.
_LISTS = (
    (rf"\b{_BOTH} , ([^,;]+ and [^,;]+) , ", r"both \1 "),
    (rf"\b{_BOTH} ({_PREPOSITION} {_THING}) , ([^,;]+ and [^,;]+){_END}", r"both \2 \1"),
    (rf" , {_BOTH} (?=go|goes|belong|should|need|have)", " "),
)
# What only says in which order: "you will have to open it first", once "you will have to" is gone.
_ORDER = (
    (rf" [;,] ({_MAKES}) (it|that|the {_THING}) first{_END}", r" , but \1 \2 first"),
    (rf" [;,] (turn|switch) it (on|off) first{_END}", r" , but \1 it \2 first"),
    (rf" , which ({_MAKES}) first{_END}", r" , but \1 it first"),
    (
        r" [,;] (?:which|it) (?:should|must|needs? to|has to) be (open|turn|switch)ed( on| off)? first"
        + _END,
        r" , but \1\2 it first",
    ),
    (rf"\bso that (?=(?:put|place|set|drop|{_MAKES})\b)", "and then "),
)

# Other constructions of what an imperative says.
_SAID_OTHERWISE = (
    (rf"\b({_THING}) is where (?:i|we) (?:want|need|would like) ({_THING}){_END}", r"put \2 to \1"),
    (rf"\b({_THING}) is where ({_THING}) (?:(?:should|needs? to|must|ha(?:s|ve) to) (?:go|be)|goes?|belongs?)"
     rf"{_END}", r"put \2 to \1"),
    (r"\b(?:what|all) (?:i|we) (?:want|need|would like) is\b", WANTED),
    (r"\bto (?:the )?(on|off)(?: position| setting)?\b(?= ?(?:[,;]|$|and|then))", r"\1"),
    (r" , (?:the|that) one(?= (?:on|in|at|next|between|by|from|near|beside|to)\b)", f" {WHICH}"),
    (r"\bfrom where it (?:is|sits|stands|lies|rests)\b", "from"),
    (r"\b(?:i|we) (?:would|want|need|wish)(?: really)?(?: like| love| prefer)?"
     r"(?: (?:to )?(?:have|see|get))?(?: for)?\b",
     WANTED),
    # "have the bowl placed on the plate", "make sure the drawer is open", "could we have the milk here"
    (r"\b(?:make sure|ensure|see to it|make certain|see(?= that))(?: that)?\b"
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
     r"|stored|stacked|sat|seated|tucked|hiding))+\b"
     r"|(?<!and )(?<!be )(?<!been )\b(?:currently|sitting|standing|lying|resting|located"
     r"|positioned|sandwiched|nestled|situated|perched|stored)\b", WHICH),
    (rf"(\w+) {WHICH} ((?:{_COLOUR})(?: and (?:{_COLOUR}))*)\b", r"\2 \1"),
    (r"\bfrom (?:its|their) (?:usual |current )?(?:place|spot|position)\b(?= \w)", "from"),
    (r"\b(?:in|to|into|at) (?:its|their) (?:usual |right )?(?:place|spot|position|home)\b(?= \w)", ""),
    # "to the stove's front side", "from the wooden cabinet's left"
    (r"\b(to|at|on|onto|from) (?:the )?([a-z]+(?: [a-z]+)?) 's (left|right|front|back|rear|top)(?: hand)?"
     rf"(?: side| edge)?{_END}",
     r"\1 the \3 of the \2"),
    (rf"\b(?:on|onto|to) the (\w+) top{_END}", r"on top of the \1"),
)  # fmt: skip

# "The bowl, the one on the stove,", "the bowl, it is on the stove,": what follows a noun and tells which.
_APPOSITIONS = (
    (
        rf" , (?:the|that) one (?:{WHICH} )?(?=(?:{_UP} )?(?:{_PREPOSITION}|at|by|from|near|close)\b)",
        f" {WHICH} ",
    ),
    (rf" , it is (?=(?:{_UP} )?(?:{_PREPOSITION}|at|by|near)\b[^;,]* , )", f" {WHICH} "),
    (
        rf"({WANTED} [^;]*?{WHICH} [^,;]+) , "
        r"(?=(?:moved|placed|put|set|taken|brought|transferred|to be|to go)\b)",
        r"\1 ",
    ),
    (rf"{_BEGIN}((?:{_PREPOSITION}) [^;,]*?) {SEEN} ((?:a|an|the) [^;,]+)", rf"{SEEN} \2 {WHICH} \1"),
    (rf"\band have (?={_NOUN} (?:{_PREPOSITION}|to)\b)", f", {WANTED} "),
    (rf"(?<=\w) , with (?={_NOUN} (?:{_PREPOSITION}|to the)\b)", f" , {WANTED} "),
    (rf"({SAME} [^;,]*?) (?:in|on|inside) (?:there|it){_END}", r"\1"),
    (rf"\bget ({_THING}) (on|off|open|shut|closed){_END}", rf"{WANTED} \1 \2"),
)
CONSTRUCTIONS = (*_PLACES, *_LISTS, *_ORDER, *_SAID_OTHERWISE, *_APPOSITIONS)
