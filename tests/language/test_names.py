"""Names of one thing: by the table of words, and by the embeddings of a model made here."""

import builtins
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.language.text_model import make_model
from tests.memory.builders import entry, semantic_candidates

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.language.meaning import semantic_score
from lerobot_openspm.language.names import MIN_COSINE, TABLE_NAMES, Model2VecNames

VECTORS = {
    "goblet": (1.0, 0.1, 0.0), "chalice": (1.0, 0.0, 0.0), "bowl": (0.0, 1.0, 0.0), "red": (0.0, 0.0, 0.01),
    "blue": (0.0, 0.0, 0.01),
}  # fmt: skip


@pytest.fixture(scope="module")
def embedded(tmp_path_factory: pytest.TempPathFactory) -> Model2VecNames:
    return Model2VecNames(str(make_model(tmp_path_factory.mktemp("model"), VECTORS)))


@pytest.mark.parametrize(
    ("asked", "known"),
    [("skillet", "frying pan"), ("cup", "mug"), ("red cup", "red mug"), ("ketchup bottle", "ketchup"),
     ("cream cheese", "cream cheese box"), ("rack", "wine rack"), ("oj", "orange juice")],
)  # fmt: skip
def test_other_words_for_a_thing_mean_it_but_its_own_words_mean_it_more(asked: str, known: str):
    assert 0.9 < TABLE_NAMES.similarity(asked, known) < TABLE_NAMES.similarity(known, known) == 1.0


@pytest.mark.parametrize(
    ("asked", "known"),
    [("white mug", "yellow and white mug"), ("red mug", "white mug"), ("box", "bowl"),
     ("plate", "plate rack"), ("soy sauce", "tomato sauce"), ("", "bowl"), ("bowl", "")],
)  # fmt: skip
def test_another_thing_is_not_taken_for_it(asked: str, known: str):
    assert TABLE_NAMES.similarity(asked, known) == 0.0


def test_fewer_words_may_be_meant_more_words_less_so():
    fewer, usual = (
        TABLE_NAMES.similarity("bottle", "wine bottle"),
        TABLE_NAMES.similarity("wine bottle", "bottle"),
    )
    unknown = TABLE_NAMES.similarity("soup bowl", "bowl")
    assert 1 > fewer > usual > 0.75 > unknown > 0


def test_embeddings_recognise_what_the_table_does_not_know(embedded: Model2VecNames):
    assert TABLE_NAMES.similarity("goblet", "chalice") == 0.0
    near = embedded.similarity("goblet", "chalice")
    assert 0.75 < near < embedded.similarity("cup", "mug")
    assert embedded.similarity("goblet", "bowl") == 0.0
    assert (
        embedded.similarity("red goblet", "blue chalice") == 0.0
    )  # near by their vectors, but of other colours
    asked, known = (
        parse_instruction("put the goblet on the plate"),
        parse_instruction("put the chalice on the plate"),
    )
    assert semantic_score(asked, known) == 0.0
    assert semantic_score(asked, known, embedded) == pytest.approx(near)


def test_embeddings_are_not_asked_of_what_the_memory_knows(embedded: Model2VecNames):
    known = entry("put the chalice on the plate")
    found = semantic_candidates("put the goblet on the plate", [known], embedded)
    assert [item[0] for item in found] == [known]
    elsewhere = entry("put the goblet on the stove")
    with pytest.raises(InstructionError, match="no entry"):
        semantic_candidates("put the goblet on the plate", [known, elsewhere], embedded)


def test_embeddings_below_the_least_cosine_are_another_thing(embedded: Model2VecNames):
    goblet, chalice = np.array(VECTORS["goblet"]), np.array(VECTORS["chalice"])
    cosine = goblet @ chalice / np.linalg.norm(goblet) / np.linalg.norm(chalice)
    assert cosine > MIN_COSINE
    embedded._min_cosine = cosine + 1e-3
    assert embedded.similarity("goblet", "chalice") == 0.0
    embedded._min_cosine = MIN_COSINE


def test_weights_that_are_missing_are_one_error_with_the_command(tmp_path: Path):
    with pytest.raises(InstructionError, match=r"no model2vec model could be read.*hf download"):
        Model2VecNames(str(tmp_path))


def test_a_missing_package_is_one_error_with_the_command(monkeypatch: pytest.MonkeyPatch):
    original = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "model2vec":
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.delitem(sys.modules, "model2vec", raising=False)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InstructionError, match=r"pip install 'lerobot_policy_openspm\[text\]'"):
        Model2VecNames("anything")


def test_embeddings_compare_the_words_of_what_the_grammar_cannot_read(tmp_path):
    model = make_model(
        tmp_path, {"scrub": (1.0, 0.1), "wipe": (1.0, 0.0), "table": (0.0, 1.0), "burn": (-1.0, 0.0)}
    )
    names, entries = Model2VecNames(str(model)), [entry("wipe the table")]
    (found,) = semantic_candidates("scrub the table", entries, names)
    assert 0.75 <= found[1] < 1
    for asked, similarity in (("scrub the table", TABLE_NAMES), ("burn the table", names)):
        with pytest.raises(InstructionError, match="no entry"):
            semantic_candidates(asked, entries, similarity)
