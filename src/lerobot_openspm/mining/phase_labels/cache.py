"""Answers kept on disk, so that no question is asked twice."""

from __future__ import annotations

import hashlib
import json
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_openspm.errors import JudgementError
from lerobot_openspm.files import write_json
from lerobot_openspm.mining.phase_labels.types import Answers, PhaseAnswer, PhaseQuestion

FORMAT, VERSION = "openspm-phase-judgement", 1
MAX_BYTES = 1_000_000

logger = logging.getLogger(__name__)


@dataclass
class AnswerCache:
    """One JSON file an episode and model.

    It is found by its content: dataset, episode, judge, and a digest of instruction, trajectory and pictures.
    An episode that was recorded again, or whose candidates moved, is asked about again.

    Attributes:
        folder: Where the files are; made when the first is written.
    """

    folder: Path

    def load(self, question: PhaseQuestion, judge: str) -> Answers | None:
        """The answers to a question; None where there are none, or they are damaged."""
        path = self._path(question, judge)
        try:
            if path.stat().st_size > MAX_BYTES:
                raise JudgementError(f"it has {path.stat().st_size} bytes, expected up to {MAX_BYTES}")
            return _read(json.loads(path.read_bytes()), self._key(question, judge), len(question.candidates))
        except FileNotFoundError:
            return None
        except (
            OSError,
            ValueError,
            RecursionError,
            OverflowError,
        ) as error:  # JudgementError is a ValueError
            logger.warning("ignoring the cached answers in %s, asking again: %s", path, error)
            return None

    def save(self, question: PhaseQuestion, judge: str, answers: Answers) -> None:
        """Keep the answers to a question. A folder that cannot be written to is no reason to stop."""
        path = self._path(question, judge)
        kept = [None if a is None else {"phase": a.phase, "confidence": a.confidence} for a in answers]
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(
                path,
                {
                    "format": FORMAT,
                    "version": VERSION,
                    "key": self._key(question, judge),
                    "dataset": question.dataset,
                    "episode": question.episode,
                    "judge": judge,
                    "answers": kept,
                },
            )
        except OSError as error:
            logger.warning("could not keep answers in %s: %s; they will be asked for again", path, error)

    def _path(self, question: PhaseQuestion, judge: str) -> Path:
        dataset = re.sub(r"[^\w.-]+", "_", question.dataset).strip(".") or "_"
        name = f"episode_{question.episode:06d}_{self._key(question, judge)[:16]}.json"
        return self.folder / dataset / name

    @staticmethod
    def _key(question: PhaseQuestion, judge: str) -> str:
        told = [question.dataset, question.episode, judge, question.digest()]
        return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def _read(data: Any, key: str, n: int) -> Answers:
    """The answers in a file's JSON. Raises JudgementError where they are none, or another question's."""
    expected = {"format": FORMAT, "version": VERSION, "key": key}
    if not isinstance(data, dict) or any(data.get(name) != value for name, value in expected.items()):
        raise JudgementError(f"expected a JSON object with {expected}")
    answers = data.get("answers")
    if not isinstance(answers, list) or len(answers) != n:
        raise JudgementError(f"'answers' is no list of {n}")
    return tuple(None if answer is None else _answer(answer) for answer in answers)


def _answer(data: Any) -> PhaseAnswer:
    if not isinstance(data, dict) or not isinstance(data.get("phase"), str):
        raise JudgementError("an answer names no phase")
    confidence = data.get("confidence")
    if not isinstance(confidence, int | float) or isinstance(confidence, bool):
        raise JudgementError(f"an answer's confidence is {str(confidence)[:40]!r}, expected a number")
    return PhaseAnswer(data["phase"], float(confidence))
