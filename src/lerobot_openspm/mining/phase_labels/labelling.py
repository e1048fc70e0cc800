"""Labelling the phases of a dataset's episodes by a judge, whatever it does.

:func:`make_judge` chooses one, :func:`label_phases` asks it about every episode and merges its evidence.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from tqdm import tqdm

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.files import write_json
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.phase_labels.annotations import annotation_judge
from lerobot_openspm.mining.phase_labels.base import PhaseJudge, PhaseLabel, PhaseLabels, PhaseQuestion
from lerobot_openspm.mining.phase_labels.endpoint import API_BASE, TIMEOUT_S, ChatEndpoint, endpoint_judge
from lerobot_openspm.mining.phase_labels.merge import merge
from lerobot_openspm.mining.phase_labels.question import ask_about
from lerobot_openspm.mining.phase_labels.qwen3vl import WEIGHTS, Qwen3VL, qwen3vl_judge

# A judge is given up after this many failures in a row, so that many episodes do not wait for nothing.
MAX_FAILURES = 3

logger = logging.getLogger(__name__)


def make_judge(
    kind: str,
    demonstrations: Demonstrations,
    model_id: str | None = None,
    api_base: str | None = None,
    timeout_s: float = TIMEOUT_S,
    device: str = "cpu",
) -> PhaseJudge:
    """Make a judge of phases.

    Args:
        kind: "openai", "qwen3vl" or "annotations".
        demonstrations: The dataset, for "annotations".
        model_id: Name of the server's model for "openai"; a name on the Hub or a folder for "qwen3vl".
        api_base: Address of the server, for "openai".
        timeout_s: How long to wait for one answer of the server.
        device: Where "qwen3vl" runs, as PyTorch names it.

    Raises:
        PhaseLabelError: The server's model is not named, or there is no such judge.
        PerceptionError: Qwen3-VL cannot be loaded.
    """
    if kind == "annotations":
        return annotation_judge(demonstrations.subtask_rows)
    if kind == "qwen3vl":
        return qwen3vl_judge(Qwen3VL.from_pretrained(model_id or WEIGHTS, device))
    if kind != "openai" or not model_id:
        raise PhaseLabelError(
            f"no judge {kind!r} with model {model_id!r}; name both, see docs/phase_labels.md"
        )
    return endpoint_judge(ChatEndpoint(api_base or API_BASE, model_id, timeout_s))


@dataclass(frozen=True)
class LabelCache:
    """Labels kept in a folder, one JSON file per question and judge, so that nothing is asked twice.

    A file is named by a digest of dataset, episode, judge, instruction, trajectory and pictures: an episode
    that was recorded again, or whose candidates moved, is asked about again.
    """

    folder: Path

    def load(self, question: PhaseQuestion, judge: str) -> PhaseLabels | None:
        """The labels of a question; None where there are none, or the file is damaged."""
        path = self._path(question, judge)
        try:
            kept = json.loads(path.read_bytes())["labels"]
            labels = tuple(None if one is None else PhaseLabel.from_json(one) for one in kept)
            if len(labels) != len(question.candidates):
                raise PhaseLabelError(f"{len(labels)} labels, expected {len(question.candidates)}")
            return labels
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            logger.warning("ignoring the cached labels in %s, asking again: %r", path, error)
            return None

    def save(self, question: PhaseQuestion, judge: str, labels: PhaseLabels) -> None:
        """Keep the labels of a question. A folder that cannot be written to is no reason to stop."""
        path = self._path(question, judge)
        kept = [label and asdict(label) for label in labels]
        file = {"dataset": question.dataset, "episode": question.episode, "judge": judge, "labels": kept}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(path, file)
        except OSError as error:
            logger.warning("could not keep labels in %s: %s; they will be asked for again", path, error)

    def _path(self, question: PhaseQuestion, judge: str) -> Path:
        told = json.dumps([question.dataset, question.episode, judge, question.digest()])
        return self.folder / f"{hashlib.sha256(told.encode()).hexdigest()}.json"


def label_phases(
    demonstrations: Demonstrations,
    mined: Sequence[MinedEpisode],
    robot: RobotModel,
    judge: PhaseJudge,
    threshold: float,
    cache: LabelCache,
) -> tuple[MinedEpisode, ...]:
    """Merge a judge's evidence into the key poses of episodes.

    Where the judge fails, the key poses stay as they were mined.

    Args:
        demonstrations: The dataset.
        mined: Its episodes with the key poses that motion and gripper give.
        robot: The robot that recorded them.
        judge: Whom to ask.
        threshold: Labels of less confidence change nothing.
        cache: Keeps the labels of a judge that looks at pictures.
    """
    asked = _Asked(judge, cache if judge.looks else None)
    labelled, counts = list[MinedEpisode](), Counter[str]()
    for item in tqdm(mined, desc="Labelling phases", unit="episode"):
        labels = asked.labels(ask_about(demonstrations, item, robot, judge.looks))
        counts["episodes"] += labels is not None
        labelled.append(item if labels is None else _merged(item, labels, threshold, counts))
    logger.info(
        "%s labelled the phases of %d of %d episodes: %d key poses surer, %d less sure, %d renamed",
        judge.name, counts["episodes"], len(mined), counts["surer"], counts["less sure"], counts["renamed"],
    )  # fmt: skip
    return tuple(labelled)


def _merged(item: MinedEpisode, labels: PhaseLabels, threshold: float, counts: Counter[str]) -> MinedEpisode:
    """An episode's key poses with merged names and confidences; counts what changed."""
    merged = merge([PhaseLabel(p.phase, p.confidence) for p in item.key_poses], labels, threshold)
    pairs = list(zip(item.key_poses, merged, strict=True))
    for pose, label in pairs:
        if label.phase != pose.phase:
            counts["renamed"] += 1
        elif label.confidence != pose.confidence:
            counts["surer" if label.confidence > pose.confidence else "less sure"] += 1
    return replace(item, key_poses=tuple(replace(pose, **vars(label)) for pose, label in pairs))


@dataclass
class _Asked:
    """A judge that is given up when it keeps failing."""

    judge: PhaseJudge
    cache: LabelCache | None
    failures: int = 0

    def labels(self, question: PhaseQuestion) -> PhaseLabels | None:
        """The judge's labels, cached or new; None where it fails."""
        name = self.judge.name
        if self.cache and (kept := self.cache.load(question, name)) is not None:
            return kept
        if self.failures >= MAX_FAILURES:
            return None
        try:
            labels = self.judge.judge(question)
        except PhaseLabelError as error:
            self.failures += 1
            if self.failures == 1:
                logger.warning("%s gave no answer, mining goes on without it: %s", name, error)
            if self.failures == MAX_FAILURES:
                logger.warning(
                    "%s failed %d times in a row and is asked no more: %s", name, MAX_FAILURES, error
                )
            return None
        self.failures = 0
        if self.cache:
            self.cache.save(question, name, labels)
        return labels
