"""Every option of ours changes something that can be observed. A new one needs a case here."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from scripts.house import own_options
from tests.mining.phase_labels.loopback_chat import LoopbackChat, Reply, question_of, say
from tests.policy.conftest import Frame, act
from tests.policy.lerobot_commands import ARM, CALIBRATION
from tests.policy.test_learning import new_config

from lerobot_openspm import episodes as running
from lerobot_openspm import training
from lerobot_openspm.configuration_openspm import JudgeConfig, OpenSPMConfig, SegmenterConfig
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.mining.mined import MinedKeyPoses
from lerobot_openspm.modeling_openspm import OpenSPMPolicy
from lerobot_openspm.perception.objects.base import Appearance
from lerobot_openspm.types import Segmentation, View

Options = dict[str, Any]
GROUPS = {"segmenter": SegmenterConfig, "judge": JudgeConfig}
SECOND_SERVER = "the second server"


def grouped(options: Options) -> Options:
    """Options by dotted name as arguments of the configuration."""
    found = {name: value for name, value in options.items() if "." not in name}
    for group, kind in GROUPS.items():
        own = {name.partition(".")[2]: v for name, v in options.items() if name.startswith(f"{group}.")}
        if own:
            found[group] = kind(**own)
    return found


def config(options: Options) -> OpenSPMConfig:
    return OpenSPMConfig(device="cpu", push_to_hub=False, **grouped(options))


@dataclass
class Trained:
    """The trained policy and what it was trained on."""

    load: Callable[..., OpenSPMPolicy]
    recorded: list[list[Frame]]
    meta: LeRobotDatasetMetadata
    mined: MinedKeyPoses

    def with_options(self, options: Options, **more: Any) -> OpenSPMPolicy:
        return self.load(**grouped(options), **more)


@pytest.fixture(scope="module")
def mined(tiny_meta: LeRobotDatasetMetadata) -> MinedKeyPoses:
    return training.dataset_processor(tiny_meta, new_config(tiny_meta)).key_poses()


@pytest.fixture
def trained(
    load: Callable[..., OpenSPMPolicy],
    recorded: list[list[Frame]],
    tiny_meta: LeRobotDatasetMetadata,
    mined: MinedKeyPoses,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Trained:
    """Also an empty current folder with a calibration whose front camera stands elsewhere."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(training, "LABELS", tmp_path / "answers")
    document = json.loads(CALIBRATION.read_text())
    pose = document["cameras"]["observation.images.front"]["T_mount_cam"]
    pose[0][3] += 0.03
    Path("moved.json").write_text(json.dumps(document))
    Path("arm.urdf").write_text(ARM.read_text())
    return Trained(load, recorded, tiny_meta, mined)


def result(call: Callable[[], Any]) -> Any:
    """What a call returns, or why it refuses."""
    try:
        return call()
    except OpenSPMError as error:
        return str(error)


# What can be observed.


def actions(trained: Trained, options: Options) -> Any:
    """What the trained policy does on recorded observations."""
    return act(trained.with_options(options), trained.recorded[:1]).tolist()


def actions_after_a_change(trained: Trained, options: Options) -> Any:
    """... when the pictures show another layout from the second observation on."""
    before, after = trained.recorded[:2]
    moved = [
        {key: later[key] if "images" in key else frame[key] for key in frame}
        for frame, later in zip(before[1:], after[1:], strict=True)
    ]
    # What has jumped aside is believed at the second look.
    return act(trained.with_options(options), [[before[0], *moved, *moved]]).tolist()


def refusal(trained: Trained, options: Options) -> Any:
    """Why the policy cannot be loaded; its class if it can."""
    return result(lambda: type(trained.with_options(options)))


def step_s(trained: Trained, options: Options) -> Any:
    """Seconds that the policy takes a step for."""
    return running.step_s(trained.with_options(options).config)


def status_far_away(trained: Trained, options: Options) -> Any:
    """The episode's status where all key poses lie outside what was demonstrated, below it or beside it."""
    policy = trained.with_options(options)
    memory = policy.require_memory()
    (name,) = options
    shift = [0, 0, 2] if name == "min_clearance_m" else [2, 0, 0]
    robot = replace(memory.robot, workspace=memory.robot.workspace + shift)
    policy.memory = replace(memory, robot=robot)
    act(policy, trained.recorded[:1])
    return policy.episodes[0].controller.state.status


def arm_length(trained: Trained, options: Options) -> Any:
    """How many joints the policy's arm has; 0 where it is not known."""
    arm = trained.with_options(options).require_memory().robot.arm
    return len(arm.joints) if arm else 0


def understood(trained: Trained, options: Options) -> Any:
    """Why an instruction with a made-up verb is refused; "" where it is not."""
    policy = trained.with_options(options)
    act(policy, [[{**trained.recorded[0][0], "task": "blick the bowl on the plate"}]])
    return policy.episodes[0].controller.state.refusal


def entries(trained: Trained, options: Options) -> Any:
    """How many demonstrations the memory holds after training goes on with one of them."""
    policy = trained.with_options(options, dataset_meta=trained.meta, memory_episodes=[0])
    return len(policy.require_memory().entries)


def episodes(trained: Trained, options: Options) -> Any:
    """The episodes that are learned from."""
    processor = training.dataset_processor(trained.meta, new_config(trained.meta, **options))
    return [item.episode.index for item in processor.key_poses().episodes]


def samples(trained: Trained, options: Options) -> Any:
    """What the flow model learns from."""
    made = training.training_set(trained.mined, trained.mined.robot, config(options))
    return [part.tolist() for part in made.draw(torch.arange(3), 1, training=False)]


def loss(trained: Trained, options: Options) -> Any:
    """The training loss of a frame."""
    policy = trained.with_options(options, dataset_meta=trained.meta).train()
    torch.manual_seed(0)
    return policy.forward({"index": torch.tensor([3])})[0].item()


def numbers(trained: Trained, options: Options) -> Any:
    """How a state is read and an action is written."""
    names = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
    state, action = config({"state_layout": names, "action_layout": names, **options}).layouts()
    vector = np.linspace(0.1, 0.7, 7)
    return state.poses(vector).tolist(), action.encode_actions(vector).tolist()


def view() -> View:
    """A picture with masks: the object of number 1 is small, that of number 2 is large."""
    labels = np.ones((8, 8), np.int32)
    labels[2:] = 2
    camera = Camera(8, 8, 8.0, 8.0, 3.5, 3.5, "world", np.eye(4))
    depth = np.ones((8, 8), np.float32)
    return View(np.zeros((8, 8, 3), np.uint8), camera, np.eye(4), depth, labels)


def masks(trained: Trained, options: Options) -> Any:
    """The pixels that the segmenter finds, or why there is none."""
    segmenter: Any = result(config(options).make_segmenter)
    if isinstance(segmenter, str):
        return segmenter
    return int(segmenter.segment({"front": view()}, ["bowl"])["bowl"]["front"][0].mask.sum())


def shape_worker(trained: Trained, options: Options) -> Any:
    """The command with which SAM 3D cannot be started; None where it is not needed."""

    def describe() -> Any:
        shapes = training.shapes_of(config(options))
        seen = Appearance(view(), Segmentation(np.ones((8, 8), bool), 1.0), np.eye(3))
        return None if shapes is None else shapes.describe([seen])

    return result(describe)


def judgement(trained: Trained, options: Options) -> Any:
    """Which server was asked for which model, and the confidences of the key poses after it answered.

    The server agrees with everything, with a confidence of 0.7, after half a second.
    """
    (first,) = trained.mined.episodes[:1]
    unsure = replace(first, key_poses=tuple(replace(pose, confidence=0.7) for pose in first.key_poses))
    known = [pose.phase for pose in first.key_poses]

    def answer(request: Options) -> Reply:
        assert len(question_of(request)["candidates"]) == len(known)
        return Reply(say(known, 0.7), wait_s=0.5)

    processor = training.dataset_processor(trained.meta, new_config(trained.meta))
    with LoopbackChat(answer).running() as chat, LoopbackChat(answer).running() as second:
        second_is_asked = options.get("judge.api_base") == SECOND_SERVER
        base = second.api_base if second_is_asked else chat.api_base
        asked = {"judge.type": "openai", "judge.model_id": "tiny-vl", **options, "judge.api_base": base}
        demonstrations, robot = processor.demonstrations, trained.mined.robot
        (found,) = training.labelled(demonstrations, (unsure,), robot, config(asked))
    models = [[request["model"] for request in server.requests] for server in (chat, second)]
    return models, [pose.confidence for pose in found.key_poses]


def evidence(trained: Trained, options: Options) -> Any:
    """Why the dataset's phases cannot be judged; how many episodes there are where nobody judges them."""
    processor = training.dataset_processor(trained.meta, new_config(trained.meta, **grouped(options)))
    return result(lambda: len(processor.key_poses().episodes))


LABELS = {"perception": "given"}
PRETRAINED = {"perception": "sam3"}
SAM3D = {
    "perception": "sam3", "segmenter.shape": "sam3d", "segmenter.sam3d_python": "nowhere",
    "segmenter.sam3d_checkout": "here",
}  # fmt: skip
NAMES = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
TURNED_NAMES = ["y", "x", "z", "roll", "pitch", "yaw", "gripper"]


@dataclass(frozen=True)
class Case:
    """What shows an option's effect, two values that it differs between, and the options it needs beside."""

    observe: Callable[[Trained, Options], Any]
    value: Any
    other: Any
    beside: Options | None = None


# What is recorded here is a pick and place, on which "closed_loop_trc" goes straight.
FLOW_EVERYWHERE = {"execution": "closed_loop"}

CASES = {
    "cameras": Case(actions, str(CALIBRATION), "moved.json"),
    "state_layout": Case(numbers, NAMES, TURNED_NAMES),
    "action_layout": Case(numbers, NAMES, TURNED_NAMES),
    "rotation": Case(numbers, None, "axis_angle"),
    "control_hz": Case(step_s, 20.0, 10.0),
    "arm": Case(arm_length, None, "arm.urdf"),
    "hand_radius_m": Case(actions, 0.08, 1.0),
    "perception": Case(refusal, "demonstrations", "oracle"),
    "tracking": Case(actions_after_a_change, True, False),
    "segmenter.weights": Case(masks, ["here"], ["there"], PRETRAINED),
    "segmenter.labels": Case(masks, {"bowl": 1}, {"bowl": 2}, LABELS),
    "segmenter.shape": Case(shape_worker, "sam3d", "box", PRETRAINED),
    "segmenter.sam3d_python": Case(shape_worker, "nowhere", "elsewhere", SAM3D),
    "segmenter.sam3d_checkout": Case(shape_worker, "here", "there", SAM3D),
    "memory_episodes": Case(episodes, [0], [1, 4]),
    "memory_update": Case(entries, "keep", "rebuild"),
    "lexicon": Case(understood, None, '{"verbs": {"put": ["blick"]}}'),
    "name_embeddings": Case(refusal, None, "nowhere"),
    "judge.type": Case(evidence, "none", "annotations"),
    "judge.api_base": Case(judgement, "the first server", SECOND_SERVER),
    "judge.model_id": Case(judgement, "tiny-vl", "large-vl"),
    "judge.confidence": Case(judgement, 0.6, 0.8),
    "judge.timeout_s": Case(judgement, 60.0, 0.2),
    "chunk_size": Case(samples, 5, 7),
    "n_action_steps": Case(actions, 5, 1, FLOW_EVERYWHERE),
    "conditioning": Case(samples, "equivariant", "paper"),
    "num_inference_steps": Case(actions, 8, 2, FLOW_EVERYWHERE),
    "samples_per_frame": Case(loss, 1, 2),
    "noise_seed": Case(actions, 0, 1, FLOW_EVERYWHERE),
    "execution": Case(actions, "closed_loop_trc", "open_loop"),
    "reach_margin_m": Case(status_far_away, 0.1, 3.0),
    "min_clearance_m": Case(status_far_away, 0.01, 3.0),
}


def test_every_option_has_a_case():
    assert sorted(CASES) == sorted(own_options())


@pytest.mark.parametrize("name", CASES)
def test_it_changes_something(name: str, trained: Trained):
    case = CASES[name]
    beside = {key: value for key, value in (case.beside or {}).items() if key != name}
    observed = [case.observe(trained, {**beside, name: value}) for value in (case.value, case.other)]
    assert observed[0] != observed[1]
