"""Answers are asked for once; whatever is not theirs is asked for anew."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from tests.mining.phase_labels.questions import PHASES, moment, pick_and_place

from lerobot_openspm.mining.phase_labels.base import PhaseLabel
from lerobot_openspm.mining.phase_labels.labelling import LabelCache

LABELS = (None, *(PhaseLabel(phase, 0.7) for phase in PHASES[1:]))
JUDGE = "openai tiny v1"


@pytest.fixture
def cache(tmp_path: Path) -> LabelCache:
    kept = LabelCache(tmp_path / "cache")
    kept.save(pick_and_place(), JUDGE, LABELS)
    return kept


def file_of(cache: LabelCache) -> Path:
    (path,) = cache.folder.rglob("*.json")
    return path


def test_what_was_kept_comes_back(cache: LabelCache):
    assert cache.load(pick_and_place(), JUDGE) == LABELS


@pytest.mark.parametrize(
    "other",
    [
        pick_and_place(episode=1),
        pick_and_place(cameras=2),
        pick_and_place(instruction="turn on the stove"),
        replace(pick_and_place(), dataset="local/b"),
        replace(pick_and_place(), trajectory=(moment(0.5, True),)),
        replace(pick_and_place(), candidates=(*pick_and_place().candidates[:-1], moment(8.0, False, 0.2))),
    ],
)
def test_another_question_has_no_answers(cache: LabelCache, other):
    assert cache.load(other, JUDGE) is None


def test_another_model_is_asked_itself(cache: LabelCache):
    assert cache.load(pick_and_place(), "openai huge v1") is None


def test_one_pixel_makes_another_question(cache: LabelCache):
    question = pick_and_place()
    (sheet,) = question.sheets["observation.images.wrist"]
    sheet[5, 5, 0] ^= 1
    assert cache.load(question, JUDGE) is None


DAMAGED = {
    "nothing": lambda _: b"",
    "no JSON": lambda _: b"\x00\xff",
    "deep": lambda _: b"[" * 900_000,
    "a list": lambda _: b"[]",
    "an answer less": lambda blob: blob.replace(b"null,", b""),
    "an unknown phase": lambda blob: blob.replace(b'"lift"', b'"fly"'),
    "a confidence of 7": lambda blob: blob.replace(b"0.7", b"7.0"),
    "a confidence of NaN": lambda blob: blob.replace(b"0.7", b"NaN"),
    "a confidence of true": lambda blob: blob.replace(b"0.7", b"true"),
    "an endless confidence": lambda blob: blob.replace(b"0.7", b"1" * 400),
    "no phase": lambda blob: blob.replace(b'"phase"', b'"phrase"'),
    "an answer that is none": lambda blob: blob.replace(b"null,", b"3,"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_files_are_ignored_with_a_warning_and_written_anew(cache, caplog, damage: str):
    path = file_of(cache)
    path.write_bytes(DAMAGED[damage](path.read_bytes()))
    assert cache.load(pick_and_place(), JUDGE) is None
    assert f"ignoring the cached labels in {path}" in caplog.text
    cache.save(pick_and_place(), JUDGE, LABELS)
    assert cache.load(pick_and_place(), JUDGE) == LABELS


def test_truncated_anywhere(cache: LabelCache):
    path, question = file_of(cache), pick_and_place(cameras=0)
    cache.save(question, JUDGE, LABELS)
    path = next(p for p in cache.folder.rglob("*.json") if p != path)
    blob = path.read_bytes().rstrip()
    for n in range(0, len(blob), max(1, len(blob) // 50)):
        path.write_bytes(blob[:n])
        assert cache.load(question, JUDGE) is None
    path.write_bytes(blob)
    assert cache.load(question, JUDGE) == LABELS


def test_a_folder_that_cannot_be_written_to_stops_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / "file").touch()
    LabelCache(tmp_path / "file").save(pick_and_place(), JUDGE, LABELS)
    assert "could not keep labels in" in caplog.text


@pytest.mark.parametrize("name", ["../../etc", "..", "a/b c", ""])
def test_a_datasets_name_leads_nowhere_else(tmp_path: Path, name: str):
    kept = LabelCache(tmp_path / "cache")
    kept.save(replace(pick_and_place(), dataset=name), JUDGE, LABELS)
    assert file_of(kept).resolve().is_relative_to((tmp_path / "cache").resolve())


def test_a_file_can_be_read_by_a_person(cache: LabelCache):
    kept = json.loads(file_of(cache).read_text())
    assert (kept["dataset"], kept["episode"], kept["judge"]) == ("local/a", 0, JUDGE)
    assert kept["labels"][2] == {"phase": "grasp", "confidence": 0.7}
