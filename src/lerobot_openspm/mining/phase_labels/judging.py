"""Judging the episodes of a dataset, whatever the judge does."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from tqdm import tqdm

from lerobot_openspm.errors import JudgementError
from lerobot_openspm.memory.robot import RobotModel
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.phase_labels.cache import AnswerCache
from lerobot_openspm.mining.phase_labels.merge import merge
from lerobot_openspm.mining.phase_labels.question import ask_about
from lerobot_openspm.mining.phase_labels.types import Answers, PhaseAnswer, PhaseJudge, PhaseQuestion

# After so many failures in a row a judge is asked no more.
MAX_FAILURES = 3

logger = logging.getLogger(__name__)


def judge_episodes(
    demonstrations: Demonstrations,
    mined: Sequence[MinedEpisode],
    robot: RobotModel,
    judge: PhaseJudge,
    threshold: float,
    cache: AnswerCache | None = None,
) -> tuple[MinedEpisode, ...]:
    """Merge a judge's evidence into the key poses of episodes.

    A judge that fails costs its evidence and nothing else: what it says nothing of stays as it was mined.

    Args:
        demonstrations: The dataset.
        mined: Its episodes with the key poses that motion and gripper tell.
        robot: The robot that gave them.
        judge: Whom to ask.
        threshold: Answers of less confidence change nothing.
        cache: Keeps the answers of a judge that looks at pictures.
    """
    asked, judged, told = _Asked(judge, cache if judge.looks else None), list[MinedEpisode](), Counter[str]()
    for item in tqdm(mined, desc="Judging phases", unit="episode"):
        answers = asked.answers(ask_about(demonstrations, item, robot, judge.looks))
        told["episodes"] += answers is not None
        judged.append(item if answers is None else _merged(item, answers, threshold, told))
    logger.info(
        "%s judged the phases of %d of %d episodes: %d key poses surer, %d less sure, %d renamed",
        judge.name, told["episodes"], len(mined), told["surer"], told["less sure"], told["renamed"],
    )  # fmt: skip
    return tuple(judged)


def _merged(item: MinedEpisode, answers: Answers, threshold: float, told: Counter[str]) -> MinedEpisode:
    """An episode's key poses with their merged names and confidences; counts what changed."""
    before = [PhaseAnswer(pose.phase, pose.confidence) for pose in item.key_poses]
    after = merge(before, answers, threshold)
    for was, is_ in zip(before, after, strict=True):
        told["renamed"] += is_.phase != was.phase
        told["surer"] += is_.phase == was.phase and is_.confidence > was.confidence
        told["less sure"] += is_.phase == was.phase and is_.confidence < was.confidence
    key_poses = (
        replace(pose, phase=answer.phase, confidence=answer.confidence)
        for pose, answer in zip(item.key_poses, after, strict=True)
    )
    return replace(item, key_poses=tuple(key_poses))


@dataclass
class _Asked:
    """A judge that is asked no more when it keeps failing, so that many episodes do not wait for nothing."""

    judge: PhaseJudge
    cache: AnswerCache | None
    failures: int = 0
    warned: bool = False

    def answers(self, question: PhaseQuestion) -> Answers | None:
        """What the judge says, or said; None where it fails."""
        name = self.judge.name
        if self.cache and (kept := self.cache.load(question, name)) is not None:
            return kept
        if self.failures >= MAX_FAILURES:
            return None
        try:
            answers = self.judge.judge(question)
        except JudgementError as error:
            self._failed(error)
            return None
        self.failures = 0
        if self.cache:
            self.cache.save(question, name, answers)
        return answers

    def _failed(self, error: JudgementError) -> None:
        self.failures += 1
        if not self.warned:
            logger.warning(
                "%s gave no answer, mining goes on without it where that happens: %s", self.judge.name, error
            )
            self.warned = True
        if self.failures == MAX_FAILURES:
            logger.warning(
                "%s failed %d times in a row and is asked no more: %s", self.judge.name, MAX_FAILURES, error
            )
