"""The words that instructions are read by: verbs, prepositions, places, parts, and other names of things."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


def word_set(words: str) -> frozenset[str]:
    """A set of words, written in one string."""
    return frozenset(words.split())


def _phrases(phrases: str) -> tuple[str, ...]:
    return tuple(phrases.split(", "))


# Verb phrases by the operation they mean. "pick" is half of a put: where a thing is taken from tells which.
VERBS: dict[str, tuple[str, ...]] = {
    "pick": _phrases(
        "pick up, pick out, pick, grab hold of, grab, grasp, take hold of, take out, take, lift up, "
        "lift out, lift, get hold of, get, fetch, retrieve, collect, gather, seize, scoop up, scoop, "
        "reach for, find, locate, remove, snag, snatch, pluck, extract, select, choose, catch, hoist, "
        "raise, unload, pull out of, secure, obtain"
    ),
    "put": _phrases(
        "put down, put back, put away, put, place, set down, set, lay down, lay, move, bring, stack, "
        "drop off, drop, deposit, position, reposition, transfer, relocate, rest, load, insert, stow "
        "away, stow, store, stick, stash, pop, tuck, slot, slip, park, file, stand, shift, deliver, "
        "carry, chuck, toss, pile, plop, situate, nestle, nest, balance, transport, return, pack, "
        "lower, ease, arrange, add, plunk, dump, fit, settle, send, leave, shelve, perch, sit, plonk, "
        "seat, install, house, keep, bung, sling, stuff, squeeze, wedge, lodge, dock, mount, hang, "
        "prop, lean, haul, lug, ferry, cart, shuttle, convey, pass, plant, line up, tidy, clear, "
        "hide, feed, thrust, guide, steer, direct, relay, release"
    ),
    "open": _phrases("open up, open"),
    "close": _phrases("close up, close, shut"),
    "push": _phrases("push, slide, shove, nudge, scoot, drag, pull, press, shunt, glide"),
    "turn on": _phrases(
        "turn on, switch on, power on, power up, start up, start, light up, light, ignite, fire up, "
        "activate, flip on, click on, flick on, heat up, enable, crank up"
    ),
    "turn off": _phrases(
        "turn off, switch off, power off, power down, shut off, shut down, extinguish, deactivate, "
        "flip off, click off, flick off, kill, disable"
    ),
}
# "slide the drawer open", "pull open the drawer": how a thing is moved, and what becomes of it.
MOTIONS = _phrases(
    "pull, push, slide, swing, draw, shove, nudge, ease, move, get, yank, tug, pop, press, crack, roll, "
    "bring, haul, put, flip, drag"
)
RESULTS = {"open": "open", "shut": "close", "closed": "close"}
# Likewise, but of drawers alone: "slide the bowl in" puts it into something.
DRAWER_RESULTS = {"out": "open", "in": "close"}
# What "turn" means without "on" or "off".
HALF_A_VERB = "half a verb"
SWITCHES = ("turn", "shut", "switch", "power", "flip", "click", "flick", "toggle", "crank", "twist")
# What a thing does that is to be somewhere: "the bowl should sit on the plate".
STANDS = word_set(
    "stay come belong sit rest stand stay lie end ends up sits rests gets land be "
    "lying sitting standing resting"
)
# Verbs that say to change nothing, unless what they are said of is in the hand.
OF_WHAT_IS_HELD = ("leave", "keep")
# "slide the pan under the shelf": where the way does not lead along the table, sliding is putting.
LIFTING_RELATIONS = ("on", "in", "under")

IRREGULAR = {  # base: (gerund, participle)
    "put": ("putting", "put"), "set": ("setting", "set"), "lay": ("laying", "laid"),
    "bring": ("bringing", "brought"), "take": ("taking", "taken"), "get": ("getting", "gotten"),
    "stick": ("sticking", "stuck"), "stand": ("standing", "stood"), "shut": ("shutting", "shut"),
    "slide": ("sliding", "slid"), "draw": ("drawing", "drawn"), "swing": ("swinging", "swung"),
    "find": ("finding", "found"), "seek": ("seeking", "sought"), "send": ("sending", "sent"),
    "leave": ("leaving", "left"), "light": ("lighting", "lit"), "sit": ("sitting", "sat"),
    "fit": ("fitting", "fitted"), "keep": ("keeping", "kept"), "grab": ("grabbing", "grabbed"),
    "drop": ("dropping", "dropped"), "pop": ("popping", "popped"), "slot": ("slotting", "slotted"),
    "slip": ("slipping", "slipped"), "plop": ("plopping", "plopped"), "flip": ("flipping", "flipped"),
    "transfer": ("transferring", "transferred"), "drag": ("dragging", "dragged"),
    "open": ("opening", "opened"), "pick": ("picking", "picked"),
}  # fmt: skip

# Prepositions by the relation they mean.
RELATIONS: dict[str, tuple[str, ...]] = {
    "on": (
        "on top of", "to the top of", "onto the top of", "at the top of", "on the top of", "atop of", "atop",
        "onto", "on to", "on", "upon", "up on", "over top of", "on the surface of",
    ),
    "in": ("inside of", "inside", "into", "in to", "in", "within", "down into"),
    "next to": (
        "next to", "beside", "alongside", "near to", "near", "close to", "by", "adjacent to",
        "at the side of", "by the side of", "nearest to", "nearest", "closest to", "close by", "against",
        "to the side of", "touching", "neighbouring",
    ),
    "between": ("in between", "between"),
    "behind": ("behind", "in back of", "in the back of"),
    "front of": ("in front of",),
    "left of": ("left of",),
    "right of": ("right of",),
    "under": ("underneath", "beneath", "below", "under", "at the bottom of", "on the bottom of"),
    "at": ("to", "towards", "toward", "at"),
}  # fmt: skip
# Those that say a place beside a thing.
BESIDE = ("next to", "behind", "front of", "left of", "right of")
# Prepositions that say where to, whatever follows, and those that say where from.
GOALS = ("onto", "on to", "into", "in to", "to", "down into", "towards", "toward",
         "to the top of", "onto the top of")  # fmt: skip
# The latter with the relation that they undo, where they say it.
SOURCES = {"from": "", "off of": "on", "off": "on", "out of": "in", "out from": "in"}
# Words before a preposition that add nothing to it: "over onto the plate", "right next to".
PARTICLES = word_set(
    "forwards across forward over down up back away right just directly straight out along immediately safely"
)
# Which way something goes, where nothing says where to.
WAYS = word_set(
    "up down forwards backward backwards inward inwards outward outwards upward upwards downward downwards "
    "sideways around across along apart through together upside clockwise counterclockwise anticlockwise"
)

# Places in the scene, among several things of one name, and in a thing's part.
PLACES = {
    "left": "left", "leftmost": "left", "lefthand": "left", "right": "right", "rightmost": "right",
    "righthand": "right", "front": "front", "frontmost": "front", "foremost": "front",
    "back": "back", "rear": "back", "backmost": "back", "rearmost": "back", "hindmost": "back",
    "middle": "middle", "centre": "middle", "center": "middle", "central": "middle", "middlemost": "middle",
}  # fmt: skip
HEIGHTS = {
    "top": "top", "upper": "top", "topmost": "top", "uppermost": "top", "highest": "top",
    "bottom": "bottom", "lower": "bottom", "lowest": "bottom", "bottommost": "bottom",
    "lowermost": "bottom",
}  # fmt: skip
# What a part is called by that stands there: "the drawer at the back of ...".
PLACE_OF_RELATION = {
    "front of": "front", "behind": "back", "left of": "left", "right of": "right", "center": "middle",
    "on": "top", "under": "bottom",
}  # fmt: skip
RELATION_OF_PLACE = {
    "front": "front of", "back": "behind", "left": "left of", "right": "right of", "middle": "center",
}  # fmt: skip

# The relations of a Reference: places of a thing among others, and prepositions as those name them.
REFERENCES = tuple(
    dict.fromkeys(
        (
            *PLACES.values(), *HEIGHTS.values(), "center",
            *({"behind": "back"}.get(name, name.removesuffix(" of")) for name in RELATIONS),
        )
    )
)  # fmt: skip

# Parts, and the thing they belong to where it is not said.
PART_OF = {"drawer": "cabinet", "burner": "stove", "knob": "stove", "compartment": "caddy"}
# Things in whose left, right, front or back there is a part: "in the front of the caddy".
PART_BY_PLACE = {"caddy": "compartment"}
# Parts that are named together with their thing alone; "the shelf" by itself may be a thing.
NAMED_PARTS = ("shelf", "door")
PART_SYNONYMS = {
    "layer": "drawer", "tier": "drawer", "level": "drawer", "section": "compartment", "slot": "compartment",
    "pocket": "compartment", "bin": "compartment", "part": "compartment", "bay": "compartment",
    "cubby": "compartment", "partition": "compartment", "division": "compartment", "area": "compartment",
    "portion": "compartment", "space": "compartment", "dial": "knob",
}  # fmt: skip
# Parts that stand for the whole: who turns on the knob of the stove turns on the stove.
SILENT_PARTS = ("knob", "burner", "door")

# Names that are told from parts only with their thing: "the left bin" stands by itself.
NAMED_WITH_THING = ("bin",)

# Other words for the same kind of thing. A memory that has one of them is asked for it by the others too.
SYNONYMS = {
    "cupboard": "cabinet", "chest of drawers": "cabinet", "drawer unit": "cabinet", "dresser": "cabinet",
    "set of drawers": "cabinet", "drawer chest": "cabinet", "drawer cabinet": "cabinet",
    "cabinet unit": "cabinet", "wooden cabinet": "cabinet", "wood cabinet": "cabinet", "bureau": "cabinet",
    "storage unit": "cabinet", "kitchen cabinet": "cabinet", "closet": "cabinet", "sideboard": "cabinet",
    "cooker": "stove", "stovetop": "stove", "stove top": "stove", "cooktop": "stove", "hob": "stove",
    "gas stove": "stove", "range": "stove", "hotplate": "stove", "hot plate": "stove",
    "microwave oven": "microwave", "desk caddy": "caddy", "desk organizer": "caddy",
    "desk organiser": "caddy", "organizer": "caddy", "organiser": "caddy",
    "akita black bowl": "black bowl", "akita bowl": "black bowl", "cookies box": "cookie box",
    "table top": "table", "tabletop": "table",
}  # fmt: skip
# Names that stay as they are said, because objects are learned under them, but mean the same in retrieval.
ALIASES = {
    "cup": "mug",
    "pan": "frying pan",
    "skillet": "frying pan",
    "fry pan": "frying pan",
    "frypan": "frying pan",
    "coffee pot": "moka pot",
    "moka": "moka pot",
    "moka coffee pot": "moka pot",
    "espresso maker": "moka pot",
    "espresso pot": "moka pot",
    "coffee maker": "moka pot",
    "moka maker": "moka pot",
    "mokapot": "moka pot",
    "wine rack": "rack",
    "bottle rack": "rack",
    "wine holder": "rack",
    "barbecue sauce": "bbq sauce",
    "barbeque sauce": "bbq sauce",
    "bar b q sauce": "bbq sauce",
    "b b q sauce": "bbq sauce",
    "catsup": "ketchup",
    "tomato ketchup": "ketchup",
    "oj": "orange juice",
    "choc pudding": "chocolate pudding",
    "choco pudding": "chocolate pudding",
    "soft cheese": "cream cheese",
    "cookies": "cookie",
    "biscuit": "cookie",
    "biscuits": "cookie",
    "dinner plate": "plate",
    "dish": "plate",
    "saucer": "plate",
    "hamper": "basket",
    "wine": "wine bottle",
    "ramekin dish": "ramekin",
    "ramekin bowl": "ramekin",
    "serving tray": "tray",
    "counter": "table",
    "worktop": "table",
    "countertop": "table",
    "novel": "book",
    "textbook": "book",
    "notebook": "book",
    "coffee mug": "mug",
    "coffee cup": "mug",
    "tea cup": "mug",
    "teacup": "mug",
    "percolator": "moka pot",
    "wine stand": "rack",
    "wicker basket": "basket",
    "shopping basket": "basket",
    "chocolate pud": "chocolate pudding",
    "letter soup": "alphabet soup",
    "biscuit box": "cookie",
    "cookie package": "cookie",
    "stovetop espresso maker": "moka pot",
}
# Short names, of the whole name alone: the "soup" is the alphabet soup, but "pumpkin soup" is not.
SHORT_NAMES = {
    "soup": "alphabet soup", "pudding": "chocolate pudding", "dressing": "salad dressing",
    "juice": "orange juice", "bbq": "bbq sauce", "barbecue": "bbq sauce", "pot": "moka pot",
}  # fmt: skip
# What things are sold in: "the can of alphabet soup" is the alphabet soup.
CONTAINERS = word_set(
    "can tin bottle box carton jar package packet pack tub stick block container bag brick jug tube "
    "cup slab bar"
)
# Things that hold what is put on them: "on the bowl" and "in the bowl" are one.
HOLLOW = word_set("bowl basket tray mug drawer compartment microwave caddy")
SURFACES = word_set("table desk counter floor")
# Things that nothing is put into: "in the rack" is on it.
OPEN_SUPPORTS = word_set("rack plate stove shelf")
# Words that say little of which thing is meant.
DESCRIPTIONS = word_set(
    "small big large tiny huge round empty full clean dirty new old heavy light shiny nice lovely "
    "pretty medium sized regular plain open closed"
)

COLOURS = word_set("black white red yellow green blue brown grey gray orange purple pink golden silver beige")
DETERMINERS = word_set("the a an some this that these those my your our its")
FILLERS = word_set("stacked also furthest farthest far other same entire whole single little said very")
_COUNTS = (
    "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve", "thirteen",
    "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty",
)  # fmt: skip
NUMBERS = {
    "both": 2, "pair of": 2, "couple of": 2,
    **{word: i for i, word in enumerate(_COUNTS, start=2)},
    **{str(i): i for i in range(2, 100)},
}  # fmt: skip
# A number before one of these is a size: "the 10 mm socket".
UNITS = word_set("mm cm m inch g kg oz ml l liter litre cent watt volt")
# Words without a plural: "2 cream cheese" are two of them, as "the 2 button" is not.
UNCOUNTABLE = word_set(
    "cheese butter milk ketchup soup sauce juice pudding dressing coffee tea water wine bread rice pasta "
    "sugar salt soap popcorn fruit food toothpaste yogurt yoghurt"
)
PRONOUNS = {
    **dict.fromkeys(("it", "this", "that", "itself"), "it"),
    "there": "there",
    **dict.fromkeys(
        ("them", "these", "those", "both", "they", "each", "all", "the two", "the two of them", "them both",
         "both of them", "all of them", "them all", "stack", "pile"),
        "them",
    ),
}  # fmt: skip

Form = Literal["base", "gerund", "participle", "third"]


@dataclass(frozen=True)
class Verb:
    """A verb phrase as it stands in an instruction.

    Attributes:
        operation: What it means, a key of :data:`VERBS`.
        word: Its first word in its base form.
        form: "base" ("put"), "gerund" ("putting"), "participle" ("put") or "third" ("puts").
        length: How many words it has.
    """

    operation: str
    word: str
    form: Form
    length: int


def _inflected(word: str) -> dict[Form, str]:
    stem = word.removesuffix("e")
    gerund, participle = IRREGULAR.get(word, (f"{stem}ing", f"{stem}ed"))
    third = f"{word}es" if word.endswith(("sh", "x", "ch", "ss")) else f"{word}s"
    return {"base": word, "gerund": gerund, "participle": participle, "third": third}


def _lexicon() -> dict[Form, dict[tuple[str, ...], Verb]]:
    phrases = [(phrase, operation) for operation, verbs in VERBS.items() for phrase in verbs]
    results = {**RESULTS, "out": "open"}
    phrases += [(f"{motion} {result}", results[result]) for motion in MOTIONS for result in results]
    phrases += [("push in", "close"), ("pull to", "close")]
    known = {phrase for phrase, _ in phrases}
    phrases += [(word, HALF_A_VERB) for word in (*MOTIONS, *SWITCHES) if word not in known]
    found: dict[Form, dict[tuple[str, ...], Verb]] = {
        "base": {}, "gerund": {}, "participle": {}, "third": {}
    }  # fmt: skip
    for phrase, operation in phrases:
        word, *particles = phrase.split()
        for form, inflected in _inflected(word).items():
            key = (inflected, *particles)
            found[form][key] = Verb(operation, word, form, len(key))
    return found


_LEXICON = _lexicon()
_LONGEST = 4
# What errors name: one verb for each operation.
USUAL_VERBS = ("pick up", "put", "open", "close", "push", "turn on", "turn off")


def match_verb(words: tuple[str, ...], at: int, form: Form = "base") -> Verb | None:
    """The longest verb phrase in a form that begins at a word."""
    for length in range(_LONGEST, 0, -1):
        verb = _LEXICON[form].get(words[at : at + length])
        if verb and words[at + length - 1 : at + length + 1] != ("in", "front"):
            return verb
    return None


def replace_ending(name: str, table: dict[str, str]) -> str:
    """Replace the longest ending of a name that a table knows: "red cup" -> "red mug"."""
    words = name.split()
    for start in range(len(words)):
        if " ".join(words[start:]) in table.values():
            return name
        if other := table.get(" ".join(words[start:])):
            return " ".join([*words[:start], other])
    return name


def kind(name: str) -> str:
    """The kind of thing that a name stands for: the "wooden cupboard" is a cabinet."""
    return replace_ending(replace_ending(name, SYNONYMS), SYNONYMS)


# Nouns of one thing that end as plurals do.
_ENDS_IN_S = word_set(
    "scissors pliers tongs tweezers goggles sunglasses headphones earphones pants trousers shorts jeans "
    "pyjamas pajamas tights leggings lens gas bus canvas series"
)


def singular(word: str) -> str:
    """The singular of a noun; the noun itself where it is one already."""
    if word in _ENDS_IN_S:
        return word
    if word in ("cookies", "movies"):
        return word[:-1]
    if word.endswith("ies"):
        return f"{word[:-3]}y"
    if word.endswith(("xes", "shes", "ches", "sses")):
        return word[:-2]
    if word == "shelves":
        return "shelf"
    return word[:-1] if word.endswith("s") and not word.endswith(("ss", "us", "is")) else word
