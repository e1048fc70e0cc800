"""Mining a dataset with each source of evidence; whatever a server does, mining goes on."""

import json
import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from benchmarks.libero.guessed_key_poses import check_sequence
from lerobot.annotations.steerable_pipeline.executor import Executor
from lerobot.annotations.steerable_pipeline.reader import iter_episodes
from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
from lerobot.annotations.steerable_pipeline.writer import LanguageColumnsWriter
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy
from tests.mining.phase_labels.loopback_chat import LoopbackChat, Reply, question_of, say
from tests.policy.lerobot_commands import CALIBRATION

from lerobot_openspm import training
from lerobot_openspm.configuration_openspm import JudgeConfig, OpenSPMConfig
from lerobot_openspm.errors import DatasetError, PerceptionError
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.mining.dataset import Demonstrations
from lerobot_openspm.mining.key_poses import KeyPose
from lerobot_openspm.mining.mined import MinedEpisode
from lerobot_openspm.mining.phase_labels import question
from lerobot_openspm.mining.phase_labels.labelling import MAX_FAILURES
from lerobot_openspm.training import dataset_processor, labelled, memory_of, training_set

NAME = "local/openspm_tabletop"


def config(**options) -> OpenSPMConfig:
    return OpenSPMConfig(device="cpu", push_to_hub=False, cameras=str(CALIBRATION), **options)


def unsure(pose: KeyPose) -> KeyPose:
    return replace(pose, confidence=min(pose.confidence, 0.7))


class Mined:
    """Key poses of the first four episodes before they are judged, some of them less sure than they are.

    Pictures are decoded once, however often they are asked about.
    """

    def __init__(self, root: Path) -> None:
        self.meta = LeRobotDatasetMetadata(NAME, root=root)
        processor = dataset_processor(self.meta, config(memory_episodes=list(range(4))))
        found = processor.key_poses()
        self.demonstrations: Demonstrations = processor.demonstrations
        self.robot = found.robot
        self.episodes = tuple(
            replace(
                item, key_poses=tuple(replace(p, confidence=min(p.confidence, 0.7)) for p in item.key_poses)
            )
            for item in found.episodes
        )
        decode, decoded = self.demonstrations.pictures, {}

        def pictures(episode, frames, n_cameras):
            if episode.index not in decoded:
                decoded[episode.index] = decode(episode, frames, n_cameras)
            return decoded[episode.index]

        self.demonstrations.pictures = pictures

    def judged(self, *judge, first: int = 4, **options) -> tuple[MinedEpisode, ...]:
        chosen = config(judge=JudgeConfig(*judge, **options))
        return labelled(self.demonstrations, self.episodes[:first], self.robot, chosen)


@pytest.fixture(autouse=True)
def answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of answers for each test."""
    monkeypatch.setattr(training, "LABELS", tmp_path / "answers")
    return training.LABELS


@pytest.fixture(scope="module")
def mined(tiny_dataset: Path) -> Mined:
    return Mined(tiny_dataset)


@pytest.fixture
def asked(mined: Mined) -> Callable[..., tuple[MinedEpisode, ...]]:
    """Ask a server about the tiny dataset."""

    def asked(chat: LoopbackChat, **options) -> tuple[MinedEpisode, ...]:
        return mined.judged("openai", chat.api_base, "tiny-vl", **options)

    return asked


def confidences(episodes) -> list[float]:
    return [pose.confidence for item in episodes for pose in item.key_poses]


def phases(episodes) -> list[list[str]]:
    return [[pose.phase for pose in item.key_poses] for item in episodes]


def knowing(mined: Mined, confidence: float = 0.8) -> Callable[..., Reply]:
    """A server that agrees with motion and gripper: it knows the episodes by the candidates' times."""
    fps = mined.demonstrations.fps
    known = {
        tuple(round(pose.frame / fps, 3) for pose in item.key_poses): [pose.phase for pose in item.key_poses]
        for item in mined.episodes
    }

    def answer(request) -> Reply:
        times = tuple(c["time_s"] for c in question_of(request)["candidates"])
        return Reply(say(known[times], confidence))

    return answer


def test_agreement_makes_every_key_pose_surer(mined: Mined, asked, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO)
    with LoopbackChat(knowing(mined)).running() as chat:
        found = asked(chat)
    assert phases(found) == phases(mined.episodes)
    assert all(
        after > before for before, after in zip(confidences(mined.episodes), confidences(found), strict=True)
    )
    assert len(chat.requests) == len(mined.episodes) == 4
    pictures = [p for p in chat.requests[0]["messages"][0]["content"] if p["type"] == "image_url"]
    assert len(pictures) == 3
    assert "openai tiny-vl v1 labelled the phases of 4 of 4 episodes" in caplog.text


def test_nothing_is_asked_twice(mined: Mined, asked):
    with LoopbackChat(knowing(mined)).running() as chat:
        first = asked(chat)
        second = asked(chat)
    assert len(chat.requests) == 4
    assert confidences(first) == confidences(second)
    assert confidences(asked(chat)) == confidences(first), "the server is gone now"


def test_below_its_threshold_a_server_changes_nothing(mined: Mined, asked):
    with LoopbackChat(knowing(mined, 0.8)).running() as chat:
        assert asked(chat, confidence=0.85) == mined.episodes


def test_a_server_that_says_the_same_of_everything_breaks_nothing(mined: Mined, asked):
    def answer(request) -> Reply:
        return Reply(say(["pre-place"] * len(question_of(request)["candidates"]), 0.99))

    with LoopbackChat(answer).running() as chat:
        found = asked(chat)
    for names in phases(found):
        check_sequence(names)
    assert phases(found) != phases(mined.episodes), "lifts are called pre-places now"
    assert [p.count("grasp") for p in phases(found)] == [p.count("grasp") for p in phases(mined.episodes)]


@pytest.mark.parametrize(
    "reply",
    [
        Reply(b"", 500),
        Reply(b"garbage"),
        Reply(say(["levitate"] * 20)),
        Reply(b"x" * 1_100_000),
        Reply(say(["lift"]), promised=10_000),
        Reply(say(["lift"]), wait_s=1.0),
    ],
)
def test_a_server_that_fails_is_asked_no_more_after_some_episodes(mined: Mined, asked, caplog, reply: Reply):
    with LoopbackChat(lambda _: reply).running() as chat:
        assert asked(chat, timeout_s=0.5) == mined.episodes
    # There is no time for second attempts, so a request is an episode.
    assert len(chat.requests) == MAX_FAILURES < len(mined.episodes)
    assert caplog.text.count("gave no answer, mining goes on") == 1
    assert caplog.text.count("is asked no more") == 1


def test_a_server_that_is_gone_costs_seconds(mined: Mined, asked, caplog: pytest.LogCaptureFixture):
    with LoopbackChat(lambda _: Reply(b"")).running() as chat:
        pass
    begin = time.monotonic()
    assert asked(chat) == mined.episodes
    assert time.monotonic() - begin < 20
    assert "is asked no more" in caplog.text


def test_the_flow_model_learns_the_phases_that_were_judged(mined: Mined):
    def answer(request) -> Reply:
        return Reply(say(["pre-place"] * len(question_of(request)["candidates"]), 0.99))

    def phases_learned(*judge) -> set[str]:
        chosen = config(memory_episodes=[0, 1], judge=JudgeConfig(*judge))
        found = dataset_processor(mined.meta, chosen).key_poses(held_out=True)
        episodes = [item.episode for item in found.episodes]
        frames = torch.cat([torch.arange(e.from_index, e.from_index + len(e)) for e in episodes])
        conditions, _ = training_set(found, found.robot, chosen).draw(frames, 1, training=False)
        return {PHASES[i] for i in conditions[:, -len(PHASES) :].argmax(dim=1).tolist()}

    with LoopbackChat(answer).running() as chat:
        told = phases_learned("openai", chat.api_base, "tiny-vl")
    assert len(chat.requests) == 2, "held-out episodes are not asked about"
    assert phases_learned() - told == {"lift"}


def test_a_server_that_fails_now_and_then_is_asked_on(mined: Mined, asked, caplog: pytest.LogCaptureFixture):
    agree, seen = knowing(mined), []

    def answer(request) -> Reply:
        seen.append(request)
        return Reply(b"no", 404) if len(seen) % 2 else agree(request)

    with LoopbackChat(answer).running() as chat:
        found = asked(chat)
    assert [after == before for before, after in zip(mined.episodes, found, strict=True)] == [True, False] * 2
    assert "is asked no more" not in caplog.text


def test_qwen3vl_judges_in_this_process(
    mined: Mined, tiny_qwen3vl_folder: Path, answers: Path, monkeypatch: pytest.MonkeyPatch
):
    # Its tokens are single letters, and a trajectory has thousands.
    monkeypatch.setattr(question, "TRAJECTORY_MOMENTS", 2)
    found = mined.judged("qwen3vl", None, str(tiny_qwen3vl_folder), confidence=0.0, first=1)
    (kept,) = (json.loads(path.read_text()) for path in answers.rglob("*.json"))
    assert kept["judge"] == f"qwen3vl {tiny_qwen3vl_folder} v1"
    assert len(kept["labels"]) == len(found[0].key_poses)
    assert {answer["phase"] for answer in kept["labels"]} <= set(PHASES)
    # Random weights are sure of nothing, so there is nothing that they could change.
    assert all(answer["confidence"] < 0.5 for answer in kept["labels"])
    assert found == mined.episodes[:1]


def test_weights_that_are_not_there_are_an_error(mined: Mined, tmp_path: Path):
    with pytest.raises(PerceptionError, match="config"):
        mined.judged("qwen3vl", None, str(tmp_path))


@pytest.fixture(scope="module")
def annotated(make_once: Callable[..., Path], tiny_dataset: Path, mined: Mined) -> Path:
    """The tiny dataset with sub-tasks in its first three episodes, written by LeRobot itself."""
    frames = {item.episode.index: {p.phase: p.frame for p in item.key_poses} for item in mined.episodes}

    def annotate(root: Path) -> None:
        shutil.copytree(tiny_dataset, root)
        records, staging = list(iter_episodes(root)), root / ".annotate_staging"
        for record in records[:3]:
            begins = frames[record.episode_index]["lift"]
            rows = [(0, "pick up the bowl"), (begins, "put the bowl on the plate")]
            EpisodeStaging(staging, record.episode_index).write(
                "plan",
                [
                    {
                        "role": "assistant", "content": text, "style": "subtask", "tool_calls": None,
                        "timestamp": record.frame_timestamps[frame],
                    }
                    for frame, text in rows
                ],
            )  # fmt: skip
        LanguageColumnsWriter().write_all(records, staging, root)
        Executor._ensure_annotation_metadata_in_info(root)

    return make_once("annotated_dataset", annotate)


def test_annotations_are_evidence(annotated: Path):
    with_rows = Mined(annotated)
    rows = with_rows.demonstrations.subtask_rows(0)
    assert [words for _, words in rows] == ["pick up the bowl", "put the bowl on the plate"]
    assert with_rows.demonstrations.subtask_rows(3) == []
    found = with_rows.judged("annotations")
    assert phases(found) == phases(with_rows.episodes)
    for before, after in zip(with_rows.episodes[:3], found[:3], strict=True):
        grown = [b.confidence < a.confidence for b, a in zip(before.key_poses, after.key_poses, strict=True)]
        assert sum(grown) >= 0.8 * len(grown)
    assert found[3] == with_rows.episodes[3]


def test_a_dataset_without_annotations_is_an_error_with_the_command(mined: Mined):
    with pytest.raises(DatasetError, match="lerobot-annotate --root="):
        mined.judged("annotations")


@pytest.mark.slow
def test_a_checkpoint_holds_what_was_judged_and_not_where_it_was_asked(mined: Mined, tmp_path: Path):
    """From the options to the memory on disk, through everything in between."""
    chosen = {"memory_episodes": [0], "pretrained_path": None}
    with LoopbackChat(knowing(mined, 0.9)).running() as chat:
        judge = JudgeConfig("openai", chat.api_base, "tiny-vl")
        policy = make_policy(config(judge=judge, **chosen), ds_meta=mined.meta)
    policy.save_pretrained(tmp_path / "checkpoint")
    assert len(chat.requests) == 1

    saved = json.loads((tmp_path / "checkpoint/config.json").read_text())
    assert saved["judge"].items() >= {"type": "openai", "model_id": "tiny-vl", "api_base": None}.items()
    unjudged = config(**chosen)
    plain = memory_of(dataset_processor(mined.meta, unjudged).mine(), unjudged)
    sure = read_memory(tmp_path / "checkpoint")
    for before, after in zip(plain.entries, sure.entries, strict=True):
        assert before.key == after.key
        pairs = list(zip(before.key_poses, after.key_poses, strict=True))
        assert any(p.confidence < q.confidence for p, q in pairs)
        assert all(p.confidence <= q.confidence for p, q in pairs)
        assert all(np.array_equal(p.T_obj_ee, q.T_obj_ee) for p, q in pairs)
