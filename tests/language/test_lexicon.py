"""The words are data: a user's file adds some, and what does not belong in it is named."""

import json
from pathlib import Path

import pytest

from lerobot_openspm.errors import InstructionError, LexiconError
from lerobot_openspm.language.instruction import parse_instruction, read_task
from lerobot_openspm.language.lexicon import ENGLISH, read_lexicon
from lerobot_openspm.language.meaning import semantic_score
from lerobot_openspm.language.names import TableNames
from lerobot_openspm.types import SubTask

WORDS = r"""
synonyms:
  bowl: [dax, "Napf"]
verbs:
  put: [blick]
  turn on: [zap on]
relations:
  on: [overtop]
"""
BOWL_ON_PLATE = (SubTask("put", "bowl", "", "on", "plate"),)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "words.yaml"
    path.write_text(WORDS)
    return path


@pytest.mark.parametrize("said", ["blick the dax overtop the plate", "blick the Napf on the plate"])
def test_words_that_are_added_are_read(file: Path, said: str):
    lexicon = read_lexicon(str(file))
    assert parse_instruction(said, lex=lexicon) == BOWL_ON_PLATE
    assert read_task(said, {"bowl", "plate"}, lexicon) == BOWL_ON_PLATE
    with pytest.raises(InstructionError):
        parse_instruction(said)
    assert parse_instruction("put the bowl on the plate", lex=lexicon) == BOWL_ON_PLATE


def test_a_word_that_is_given_another_meaning_has_that_one_alone():
    lexicon = read_lexicon(json.dumps({"verbs": {"put": ["Slide"]}}))
    assert (ENGLISH.verbs["slide"], lexicon.verbs["slide"]) == ("push", "put")
    assert {word: lexicon.verbs[word] for word in ENGLISH.verbs} == {**ENGLISH.verbs, "slide": "put"}


def test_a_name_that_is_added_means_the_same_in_retrieval(file: Path):
    names = TableNames(read_lexicon(str(file)))
    asked = read_task("put the dax on the plate", lex=names.lexicon)
    assert semantic_score(asked, BOWL_ON_PLATE, names) > 0.9
    assert semantic_score(asked, BOWL_ON_PLATE) == 0.0


def test_what_a_file_adds_is_kept_as_text_that_is_read_again(file: Path):
    added = read_lexicon(str(file)).added
    assert json.loads(added)["synonyms"] == {"bowl": ["dax", "Napf"]}
    assert read_lexicon(added).synonyms == read_lexicon(str(file)).synonyms
    assert read_lexicon().added == ""
    assert read_lexicon().verbs == ENGLISH.verbs


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("synonims: {bowl: [dax]}", r"words.yaml has the key 'synonims', expected some of .*synonyms"),
        ("synonyms: [dax]", r"words.yaml, synonyms: is .*dax.*, expected for each meaning a list of words"),
        ("colours: teal", r'words.yaml, colours: is "teal", expected a list of words'),
        ("verbs: {juggle: [juggle]}", r"words.yaml, verbs: has 'juggle', expected some of pick, put, open"),
        ("constructions: [['(a+)+$', b]]", r"key 'constructions', whose regular expressions are fixed"),
        (
            "refused: {no: [a+]}",
            r"key 'refused', whose regular expressions are fixed, expected",
        ),
        ("colours: ['(a+)+$']", r"words.yaml, colours: is .*, expected a list of words"),
        ("synonyms: {bowl: ['(a+)+ of b']}", r"words.yaml, synonyms: is .*, expected for each meaning"),
        ("- bowl", r"words.yaml is .*expected keys such as 'synonyms'"),
        ("a: [", r"words.yaml is no YAML"),
    ],
)
def test_what_does_not_belong_in_a_file_is_named(tmp_path: Path, text: str, words: str):
    path = tmp_path / "words.yaml"
    path.write_text(text)
    with pytest.raises(LexiconError, match=words):
        read_lexicon(str(path))


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("/dev/zero", "is no file"),
        ("{" + "".join(f'"{i}": &x{i} [*x{i - 1}, *x{i - 1}], ' for i in range(1, 60)) + "}", "is no JSON"),
        ('{"synonyms": ' + "[" * 200_000, "is no JSON"),
    ],
)
def test_what_a_strangers_checkpoint_names_is_not_read_without_end(source: str, words: str):
    with pytest.raises(LexiconError, match=words):
        read_lexicon(source)


def test_a_file_that_is_too_long_is_refused(tmp_path: Path):
    path = tmp_path / "words.yaml"
    path.write_text("#" * 2**20 + "\n")
    with pytest.raises(LexiconError, match="has 1048577 bytes, expected up to 1048576"):
        read_lexicon(str(path))


def test_a_file_that_is_missing_is_named_with_the_option(tmp_path: Path):
    with pytest.raises(LexiconError, match=r"none.yaml cannot be read: .*--policy.lexicon=FILE"):
        read_lexicon(str(tmp_path / "none.yaml"))
