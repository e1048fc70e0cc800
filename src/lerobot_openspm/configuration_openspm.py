"""The policy's configuration: every option of ``--policy.*``, documented one by one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args
from urllib.parse import urlsplit

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_openspm.geometry.vector_layout import RotationKind, VectorLayout, parse_layout
from lerobot_openspm.types import Conditioning, Execution, Segmenter, Shape

PerceptionSource = Literal["demonstrations", "sam3", "grounded_sam2", "given", "oracle"]
MemoryUpdate = Literal["keep", "append", "rebuild"]
JudgeType = Literal["none", "openai", "qwen3vl", "annotations"]

# Perceptions with weights of their own, and all with masks.
PRETRAINED = ("sam3", "grounded_sam2")
SEGMENTERS = (*PRETRAINED, "given")
CHOICES = {
    "perception": PerceptionSource,
    "memory_update": MemoryUpdate,
    "conditioning": Conditioning,
    "execution": Execution,
}

# The flow model's training. The rate has decayed after the 3000 steps of the ready-made configurations.
LEARNING_RATE, FINAL_RATE = 2e-3, 2e-3 / 50
WEIGHT_DECAY, GRADIENT_NORM = 1e-4, 1.0
WARMUP_STEPS, DECAY_STEPS = 50, 3000


@dataclass
class SegmenterConfig:
    """What a segmenter needs, and what is learned from its masks: ``--policy.segmenter.*``.

    Args:
        weights: Hub names or folders of a pretrained segmenter's weights: one for perception "sam3", detector
            and masks for "grounded_sam2". The usual ones if not given.
        labels: Number of each phrase in the masks, for perception "given", e.g. ``{"bowl": 1}``.
        shape: What is learned of an object. "demonstrations": its shape, from the masks of all of them.
            "box": the upright box or cylinder around it; one demonstration is enough. "sam3d": the same box,
            of the size that SAM 3D Objects estimates, which runs in its own environment.
        sam3d_python: Python of the environment that SAM 3D Objects is installed in, see ``docs/sam3d.md``.
        sam3d_checkout: Folder of its repository, with its weights.
    """

    weights: list[str] | None = None
    labels: dict[str, int] | None = None
    shape: Shape = "demonstrations"
    sam3d_python: str | None = None
    sam3d_checkout: str | None = None

    def __post_init__(self) -> None:
        _require_choice("segmenter.shape", self.shape, get_args(Shape))
        if self.shape != "sam3d" and (self.sam3d_python or self.sam3d_checkout):
            raise ValueError(
                f"segmenter.sam3d_python and sam3d_checkout are for shape 'sam3d', got {self.shape!r}; "
                "pass --policy.segmenter.shape=sam3d too, or leave them out"
            )
        for phrase, number in (self.labels or {}).items():
            if type(number) is not int or number < 1:
                raise ValueError(f"segmenter.labels[{phrase!r}] is {number!r}, expected a number from 1 on")


@dataclass
class JudgeConfig:
    """What says, beside motion and gripper, which phase ends at a key pose: ``--policy.judge.*``.

    See ``docs/phase_labels.md``.

    Args:
        type: "none". "openai": a multimodal model behind an OpenAI-compatible endpoint. "qwen3vl": Qwen3-VL
            in this process. "annotations": the sub-tasks that lerobot-annotate wrote.
        api_base: Address of the endpoint of "openai", up to and with ``/v1``; lerobot-annotate's default,
            ``http://localhost:8000/v1``, if not given. Its key, if it wants one, is read from the environment
            variable OPENSPM_JUDGE_API_KEY.
        model_id: Which of the endpoint's models to ask. For "qwen3vl" a Hub name or a folder;
            ``Qwen/Qwen3-VL-2B-Instruct`` if not given.
        confidence: An answer below this confidence, from 0 to 1, changes nothing.
        timeout_s: How long to wait for the endpoint's answer about one episode, in seconds.
    """

    type: JudgeType = "none"
    api_base: str | None = None
    model_id: str | None = None
    confidence: float = 0.6
    timeout_s: float = 60.0

    def __post_init__(self) -> None:
        _require_choice("judge.type", self.type, get_args(JudgeType))
        _require("judge.confidence", self.confidence, 0 <= self.confidence <= 1, "0 to 1")
        _require("judge.timeout_s", self.timeout_s, self.timeout_s > 0, "more than 0")
        if self.type == "openai" and not self.model_id:
            raise ValueError(
                "judge.type is 'openai', but judge.model_id is not given; pass --policy.judge.model_id=NAME, "
                "one of those that the endpoint's /models lists"
            )
        if self.api_base is None:
            return
        if self.type != "openai":
            raise ValueError(
                f"judge.api_base is for judge.type 'openai', got {self.type!r}; pass "
                "--policy.judge.type=openai too, or leave it out"
            )
        address = urlsplit(self.api_base)
        plain = not (address.query or address.fragment or "@" in address.netloc)
        if address.scheme not in ("http", "https") or not address.hostname or not plain:
            raise ValueError(
                "judge.api_base is no plain http:// or https:// address (without user, password or query, "
                "which would be logged); pass e.g. http://localhost:8000/v1, and a key in the environment "
                "variable OPENSPM_JUDGE_API_KEY"
            )


@PreTrainedConfig.register_subclass("openspm")
@dataclass
class OpenSPMConfig(PreTrainedConfig):
    """Configuration of OpenSPM.

    The defaults are those measured on the bundled tabletop. What must be given for a new robot is the
    calibration of its cameras, and the layouts of state and action where feature names do not tell them. The
    optimizer and its schedule are LeRobot's options: ``--optimizer.*`` and ``--scheduler.*`` with
    ``--use_policy_training_preset=false``.

    Args:
        cameras: Calibration file of the cameras to look through (see ``configs/cameras``). Needed for
            training; a checkpoint carries its own, which this replaces when given.
        state_layout: Name of every number of ``observation.state``; read from the dataset if not given. See
            `lerobot_openspm.geometry.vector_layout` for the names.
        action_layout: Name of every number of ``action``; read from the dataset if not given.
        rotation: How state and action write rotations, where their names are wrong about it: "axis_angle",
            "quat" or "euler"; "none" ignores the rotation. Where the two differ, name them in the layouts.
        control_hz: Actions per second; the dataset's if not given. It tells how long things are out of sight.
        arm: URDF of the arm, from the world to the link ``ee``, the hand (see ``configs/arms``). Key poses
            that its joints cannot reach are refused, grasps of symmetric objects turned. It is kept with
            the checkpoint.
        hand_radius_m: Radius of the hand, in metres. It hides what is behind it, and keeps clear of objects.
        perception: What finds objects. "demonstrations": the colours, patches, surfaces and shapes that
            these show. "sam3" and "grounded_sam2": pretrained segmenters that take any phrase. "given": masks
            in ``observation.masks.<camera>``. "oracle": the simulator's poses, for ablations only.
        tracking: Whether objects are followed through the episode. Otherwise they are found once, as in the
            paper, and later pictures are neither needed nor used.
        segmenter: What a segmenter needs, and what is learned from its masks.
        memory_episodes: Indices of the episodes that may enter the memory and the training samples; all if
            not given. Name them when some are held out: the policy is shown the whole dataset otherwise.
        memory_update: What happens to a checkpoint's memory when training goes on from it: "keep" it,
            "append" the dataset's episodes, or "rebuild" it from them.
        name_embeddings: Folder or Hub name of a model2vec model that recognises names of objects which the
            lexicon does not know; needs the extra ``[text]``. None: the lexicon alone.
        lexicon: File of words beside those of ``lerobot_openspm/language/lexicon.yaml``,
            in the same form. A checkpoint keeps its contents here.
        judge: What says, beside motion and gripper, which phase ends at a key pose.
        chunk_size: Actions per chunk, the paper's H.
        n_action_steps: Actions executed before the next chunk, 1 to ``chunk_size``. Chunks are asked for on
            every way, or by the default ``execution`` where something is pushed, pulled or turned.
        conditioning: "equivariant" gives the flow model the relative pose in the frame of the target key
            pose; "paper" gives it the poses in the world.
        num_inference_steps: Euler steps from noise to a chunk. More are slower and follow the flow closer.
        samples_per_frame: (frame, noise, time) samples drawn for each frame that the loader brings. Loading
            a frame takes longer than learning from a hundred samples.
        noise_seed: Seed of the flow model's noise, which is drawn per (seed, episode, chunk).
        execution: How key poses are followed: "open_loop" plans each chunk from where the hand should be,
            "closed_loop" from where it is. "closed_loop_trc" adds terminal residual correction, and goes
            straight where nothing is pushed, pulled or turned.
        reach_margin_m: How far outside the demonstrated workspace a key pose may lie, in metres, where the
            arm's joints are not known. What lies further out is refused.
        min_clearance_m: How far below the lowest demonstrated hand position a key pose may lie, in metres.
    """

    # Poses and images are used as they are. LeRobot's processors ask for it; it is no option.
    normalization_mapping: ClassVar[dict[str, NormalizationMode]] = dict.fromkeys(
        ("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY
    )

    # Robot and cameras.
    cameras: str | None = None
    state_layout: list[str] | None = None
    action_layout: list[str] | None = None
    rotation: RotationKind | None = None
    control_hz: float | None = None
    arm: str | None = None
    hand_radius_m: float = 0.08

    # Perception.
    perception: PerceptionSource = "demonstrations"
    tracking: bool = True
    segmenter: SegmenterConfig = field(default_factory=SegmenterConfig)

    # Memory.
    memory_episodes: list[int] | None = None
    memory_update: MemoryUpdate = "keep"
    name_embeddings: str | None = None
    lexicon: str | None = None
    judge: JudgeConfig = field(default_factory=JudgeConfig)

    # Flow model.
    chunk_size: int = 5
    n_action_steps: int = 5
    conditioning: Conditioning = "equivariant"
    num_inference_steps: int = 8
    samples_per_frame: int = 256
    noise_seed: int = 0

    # Control.
    execution: Execution = "closed_loop_trc"
    reach_margin_m: float = 0.10
    min_clearance_m: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, kinds in CHOICES.items():
            _require_choice(name, getattr(self, name), get_args(kinds))
        if self.rotation is not None:
            _require_choice("rotation", self.rotation, get_args(RotationKind))
        self._check_segmentation()
        steps, most = self.n_action_steps, self.chunk_size
        _require("n_action_steps", steps, 1 <= steps <= most, f"1 to chunk_size ({most})")
        for name in ("num_inference_steps", "samples_per_frame", "hand_radius_m", "control_hz"):
            value = getattr(self, name)
            _require(name, value, value is None or value > 0, "more than 0")  # NaN is not either
        for name in ("reach_margin_m", "min_clearance_m", "noise_seed"):
            _require(name, getattr(self, name), getattr(self, name) >= 0, "0 or more")

    def _check_segmentation(self) -> None:
        """Options of a segmenter need a segmenter."""
        labels, has_masks = self.segmenter.labels, self.perception in SEGMENTERS
        if not has_masks and self.segmenter.shape != "demonstrations":
            raise ValueError(
                f"segmenter.shape is {self.segmenter.shape!r}, but perception {self.perception!r} has "
                "no masks; pass --policy.perception=sam3, grounded_sam2 or given"
            )
        if self.segmenter.weights and self.perception not in PRETRAINED:
            raise ValueError(
                f"segmenter.weights are for perception {' and '.join(PRETRAINED)}, got "
                f"{self.perception!r}; pass --policy.perception=sam3 too, or leave them out"
            )
        if (self.perception == "given") != (labels is not None):
            raise ValueError(
                f"perception is {self.perception!r}, segmenter.labels is {labels}, expected labels with "
                "perception=given and with nothing else; pass e.g. --policy.perception=given "
                """--policy.segmenter.labels='{"bowl": 1}'"""
            )

    def without_places(self) -> OpenSPMConfig:
        """A copy to save: addresses and folders that mean nothing on another machine are left out."""
        names = self.name_embeddings
        return replace(
            self,
            cameras=None,
            arm=None,
            segmenter=replace(self.segmenter, sam3d_python=None, sam3d_checkout=None),
            judge=replace(self.judge, api_base=None),
            name_embeddings=None if names and Path(names).is_dir() else names,
        )

    def set_dataset_feature_metadata(self, features: Mapping[str, Any]) -> None:
        """Take the layouts from the dataset's feature names where they were not given. Called by LeRobot."""
        self.state_layout = self.state_layout or feature_names(features.get(OBS_STATE, {}).get("names"))
        self.action_layout = self.action_layout or feature_names(features.get(ACTION, {}).get("names"))

    def make_segmenter(self) -> Segmenter | None:
        """What finds the objects' masks; None where there are none.

        Raises:
            PerceptionError: It cannot be used.
        """
        if self.perception not in SEGMENTERS:
            return None
        from lerobot_openspm.perception.segmentation.make import make_segmenter

        weights, labels = self.segmenter.weights or (), self.segmenter.labels or {}
        return make_segmenter(self.perception, labels, weights, str(self.device))

    def layouts(self) -> tuple[VectorLayout, VectorLayout]:
        """Layouts of state and action. Raises LayoutError when names are missing or make no sense."""
        return (
            parse_layout(self.state_layout or [], "state", self.rotation),
            parse_layout(self.action_layout or [], "action", self.rotation),
        )

    @property
    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """Height and width of every camera's images."""
        return {key: (int(f.shape[-2]), int(f.shape[-1])) for key, f in self.image_features.items()}

    def validate_features(self) -> None:
        """Check that there are images, a state and an action, of the sizes that the layouts name."""
        if not self.image_features:
            raise ValueError(
                f"OpenSPM needs at least one camera, got input features {sorted(self.input_features or {})}; "
                "record with a camera, or name its images observation.images.<name>"
            )
        for name, feature, layout in (
            (OBS_STATE, self.robot_state_feature, self.state_layout),
            (ACTION, self.action_feature, self.action_layout),
        ):
            if feature is None:
                got = sorted({**(self.input_features or {}), **(self.output_features or {})})
                raise ValueError(f"OpenSPM needs {name!r}, got features {got}; rename with --rename_map")
            if layout is not None and len(layout) != feature.shape[0]:
                raise ValueError(
                    f"{name} has {feature.shape[0]} numbers, but its layout names {len(layout)}: {layout}; "
                    "give one name per number in --policy.state_layout and --policy.action_layout"
                )

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW over the flow model, as LeRobot's training uses it unless told otherwise."""
        return AdamWConfig(lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY, grad_clip_norm=GRADIENT_NORM)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        """Cosine decay; LeRobot shortens it for fewer training steps."""
        return CosineDecayWithWarmupSchedulerConfig(
            peak_lr=LEARNING_RATE,
            decay_lr=FINAL_RATE,
            num_warmup_steps=WARMUP_STEPS,
            num_decay_steps=DECAY_STEPS,
        )

    @property
    def observation_delta_indices(self) -> None:
        """One observation at a time."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """None: chunks come from the mined segments; the loader's would run across key poses."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """No rewards are used."""
        return None


def _require_choice(name: str, got: str, expected: tuple[str, ...]) -> None:
    _require(name, repr(got), got in expected, f"one of {', '.join(expected)}")


def _require(name: str, got: object, is_right: bool, expected: str) -> None:
    if not is_right:
        raise ValueError(f"{name} is {got}, expected {expected}")


def feature_names(names: Any) -> list[str] | None:
    """Feature names as a list; LeRobot datasets also write them as ``{"motors": [...]}``."""
    if isinstance(names, Mapping):
        names = [name for group in names.values() for name in group]
    return [str(name) for name in names] if names else None
