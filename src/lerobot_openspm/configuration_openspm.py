"""The policy's configuration: every option of ``--policy.*``, documented one by one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args
from urllib.parse import urlsplit

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_openspm.control.checks import TransferLimits
from lerobot_openspm.control.strategies import ControlSettings, Execution
from lerobot_openspm.flow.condition import Conditioning
from lerobot_openspm.geometry.vector_layout import ROTATION_KINDS, VectorLayout, parse_layout
from lerobot_openspm.memory.retrieval import ScoreWeights
from lerobot_openspm.types import Segmenter, Shape

PerceptionSource = Literal["demonstrations", "oracle"]
Segmentation = Literal["demonstrations", "sam3", "grounded_sam2", "given"]
MemoryUpdate = Literal["keep", "append", "rebuild"]
Judge = Literal["none", "openai", "qwen3vl", "annotations"]


@PreTrainedConfig.register_subclass("openspm")
@dataclass
class OpenSPMConfig(PreTrainedConfig):
    """Configuration of OpenSPM.

    The defaults are those measured on the bundled tabletop. What must be given for a new robot is the
    calibration of its cameras, and the layouts of state and action where the dataset's feature names do not
    tell them.

    Args:
        cameras: Calibration file of the cameras to look through (see ``configs/cameras``). Needed for
            training; a checkpoint carries its own, which this replaces when given.
        state_layout: Name of every number of ``observation.state``; read from the dataset if not given. See
            `lerobot_openspm.geometry.vector_layout` for the names.
        action_layout: Name of every number of ``action``; read from the dataset if not given.
        state_rotation: How the state writes the rotation, where its names are wrong about it: "axis_angle",
            "quat", "euler" or "none".
        action_rotation: Likewise for the action.
        control_hz: How often the robot takes an action; what the dataset says of itself if not given. Actions
            are counted in steps; only how long something was not seen is told in seconds.
        hand_radius_m: Radius of the hand, which hides from the cameras what is behind it.
        perception: "demonstrations" finds objects in the images, by what the demonstrations showed of them.
            "oracle" takes their poses from the simulator, for ablations only.
        tracking: Whether objects are followed through the episode, and key poses with them. Otherwise they
            are found once, at its start, as in the paper, and no picture is looked at, nor missed, after it.
        segmentation: What finds the objects' pixels. "demonstrations": the colours and patches that the
            demonstrations showed. "sam3" and "grounded_sam2": pretrained models that take any phrase.
            "given": the numbers in ``observation.masks.<camera>``.
        segmentation_weights: Names on the Hub, or folders, of a pretrained segmenter's weights: one for
            "sam3", detector and masks for "grounded_sam2"; the usual ones if not given.
        shape: What is learned of an object that a segmenter finds. "demonstrations": its shape, from the
            masks of all of them. "box": the upright box or cylinder around it; one demonstration is enough.
            "sam3d": the same, of the size that SAM 3D Objects tells, which runs in its own environment.
        sam3d_python: Python of the environment that SAM 3D Objects is installed in, see ``docs/sam3d.md``.
        sam3d_checkout: Folder of its repository, with its weights.
        mask_labels: Number of each phrase in the masks, for segmentation "given", e.g. ``{"bowl": 1}``.
        memory_episodes: Episodes that may enter the memory and the training samples; all if not given. Name
            them when some are held out: the policy is shown the whole dataset otherwise.
        memory_update: What happens to a checkpoint's memory when training goes on from it: "keep" it,
            "append" the dataset's episodes, or "rebuild" it from them.
        phase_judge: Who says, beside motion and gripper, which phase ends at a key pose; see
            ``docs/judgement.md``. "none". "openai": a multimodal model behind an OpenAI-compatible endpoint.
            "qwen3vl": Qwen3-VL in this process. "annotations": the sub-tasks that lerobot-annotate wrote.
        phase_judge_api_base: Where the endpoint of "openai" is, up to and with ``/v1``; lerobot-annotate's
            default, ``http://localhost:8000/v1``, if not given. Its key, if it wants one, is read from the
            environment variable OPENSPM_JUDGE_API_KEY.
        phase_judge_model_id: Which of the endpoint's models to ask. For "qwen3vl" a name on the Hub, or a
            folder; ``Qwen/Qwen3-VL-2B-Instruct`` if not given.
        phase_judge_confidence: What a judge says with less confidence changes nothing.
        phase_judge_timeout_s: How long to wait for the endpoint's answer about one episode.
        phase_judge_cache: Folder to keep answers in, so that nothing is asked twice;
            ``openspm/phase_judgements`` in LeRobot's cache if not given.
        chunk_size: Actions per chunk, the paper's H.
        n_action_steps: Actions executed before the next chunk.
        conditioning: "equivariant" tells the flow model the relative pose in the frame of the target key
            pose; "paper" tells it the poses in the world.
        hidden_dim: Width of the flow model; the default gives about 240 K parameters.
        num_inference_steps: Euler steps from noise to a chunk.
        samples_per_frame: (frame, noise, time) samples drawn for each frame that the loader brings. The
            loader takes longer for one frame than the model for a hundred.
        perturbation_m: Spread of the displacements added to training samples.
        perturbation_rad: Spread of the rotations added to training samples.
        execution: "open_loop", "closed_loop", or "closed_loop_trc" with terminal residual correction.
        residual_m: A contact key pose is met within this distance, the paper's epsilon_r.
        residual_rad: ... and this angle.
        passing_m: A key pose in free space is passed within this distance.
        passing_rad: ... and this angle.
        max_corrections: Corrective chunks per key pose before it counts as not met.
        max_attempts: How often a missed grasp or an unmet key pose is tried again in an episode.
        name_embeddings: Folder, or name on the Hub, of a model2vec model that recognises names of objects
            which the table of words does not know; needs the extra ``[text]``. None: the table alone.
        weight_semantic: The paper's lambda_s, weight of the instruction in retrieval.
        weight_geometric: The paper's lambda_g, weight of the scene.
        weight_quality: The paper's lambda_r, weight of the entry's quality.
        reach_margin_m: How far outside the demonstrated workspace a key pose may lie.
        max_jump_m: Longest way between consecutive key poses.
        max_jump_rad: Largest turn between consecutive key poses.
        min_clearance_m: How far below the lowest demonstrated hand position a key pose may lie.
        noise_seed: Seed of the flow model's noise, which is drawn per (seed, episode, chunk).
    """

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )

    # Robot and cameras.
    cameras: str | None = None
    state_layout: list[str] | None = None
    action_layout: list[str] | None = None
    state_rotation: str | None = None
    action_rotation: str | None = None
    control_hz: float | None = None
    hand_radius_m: float = 0.08

    # Memory and perception.
    perception: PerceptionSource = "demonstrations"
    tracking: bool = True
    segmentation: Segmentation = "demonstrations"
    segmentation_weights: list[str] | None = None
    shape: Shape = "demonstrations"
    sam3d_python: str | None = None
    sam3d_checkout: str | None = None
    mask_labels: dict[str, int] | None = None
    memory_episodes: list[int] | None = None
    memory_update: MemoryUpdate = "keep"
    name_embeddings: str | None = None
    phase_judge: Judge = "none"
    phase_judge_api_base: str | None = None
    phase_judge_model_id: str | None = None
    phase_judge_confidence: float = 0.6
    phase_judge_timeout_s: float = 60.0
    phase_judge_cache: str | None = None
    weight_semantic: float = 1.0
    weight_geometric: float = 0.5
    weight_quality: float = 0.5

    # Flow model.
    chunk_size: int = 5
    n_action_steps: int = 5
    conditioning: Conditioning = "equivariant"
    hidden_dim: int = 268
    num_inference_steps: int = 8
    samples_per_frame: int = 256
    perturbation_m: float = 0.006
    perturbation_rad: float = 0.04
    noise_seed: int = 0

    # Control.
    execution: Execution = "closed_loop_trc"
    residual_m: float = 0.004
    residual_rad: float = 0.06
    passing_m: float = 0.015
    passing_rad: float = 0.15
    max_corrections: int = 8
    max_attempts: int = 3
    reach_margin_m: float = 0.10
    max_jump_m: float = 0.8
    max_jump_rad: float = 2.8
    min_clearance_m: float = 0.01

    # Training.
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4
    scheduler_warmup_steps: int = 50
    scheduler_decay_steps: int = 3000

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_choice("perception", self.perception, get_args(PerceptionSource))
        _require_choice("segmentation", self.segmentation, get_args(Segmentation))
        _require_choice("shape", self.shape, get_args(Shape))
        self._check_segmentation()
        _require_choice("phase_judge", self.phase_judge, get_args(Judge))
        self._check_judge()
        _require_choice("memory_update", self.memory_update, get_args(MemoryUpdate))
        _require_choice("conditioning", self.conditioning, get_args(Conditioning))
        _require_choice("execution", self.execution, get_args(Execution))
        scaled = {k: v for k, v in self.normalization_mapping.items() if v is not NormalizationMode.IDENTITY}
        if scaled:
            raise ValueError(
                f"normalization_mapping scales {scaled}, but OpenSPM works on poses and images as they are; "
                "leave it out"
            )
        for name in ("state_rotation", "action_rotation"):
            if getattr(self, name) is not None:
                _require_choice(name, getattr(self, name), ROTATION_KINDS)
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"n_action_steps is {self.n_action_steps}, expected 1 to chunk_size ({self.chunk_size})"
            )
        positive = (
            "hidden_dim", "num_inference_steps", "samples_per_frame", "residual_m", "residual_rad",
            "passing_m", "passing_rad", "hand_radius_m", "max_jump_m", "max_jump_rad", "optimizer_lr",
            "scheduler_decay_steps", "phase_judge_timeout_s",
        )  # fmt: skip
        for name in positive:
            if not getattr(self, name) > 0:  # NaN is not either
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")
        if self.control_hz is not None and not self.control_hz > 0:
            raise ValueError(f"control_hz is {self.control_hz}, expected more than 0, or none")
        not_negative = (
            "perturbation_m", "perturbation_rad", "max_corrections", "max_attempts", "reach_margin_m",
            "min_clearance_m", "weight_semantic", "weight_geometric", "weight_quality", "noise_seed",
        )  # fmt: skip
        for name in not_negative:
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 or more")

    def _check_segmentation(self) -> None:
        """Options that say something of masks need something that gives masks."""
        if self.segmentation == "demonstrations" and self.shape != "demonstrations":
            raise ValueError(
                f"shape is {self.shape!r}, but without a segmenter colours and shape are learned together; "
                "pass --policy.segmentation=sam3, grounded_sam2 or given"
            )
        if self.shape != "sam3d" and (self.sam3d_python or self.sam3d_checkout):
            raise ValueError(
                f"sam3d_python and sam3d_checkout are for shape 'sam3d', got {self.shape!r}; pass "
                "--policy.shape=sam3d too, or leave them out"
            )
        if self.segmentation != "demonstrations" and self.perception == "oracle":
            raise ValueError(
                f"segmentation is {self.segmentation!r}, but perception=oracle looks at no masks; leave one "
                "of the two out"
            )
        if (self.segmentation == "given") != (self.mask_labels is not None):
            raise ValueError(
                f"segmentation is {self.segmentation!r}, mask_labels is {self.mask_labels}, expected labels "
                "with segmentation=given and with nothing else; pass e.g. --policy.segmentation=given "
                """--policy.mask_labels='{"bowl": 1}'"""
            )
        for phrase, number in (self.mask_labels or {}).items():
            if type(number) is not int or number < 1:
                raise ValueError(f"mask_labels[{phrase!r}] is {number!r}, expected a number from 1 on")

    def _check_judge(self) -> None:
        """An endpoint needs a plain address, a model's name and somebody who asks it."""
        if not 0 <= self.phase_judge_confidence <= 1:
            raise ValueError(f"phase_judge_confidence is {self.phase_judge_confidence}, expected 0 to 1")
        if self.phase_judge == "openai" and not self.phase_judge_model_id:
            raise ValueError(
                "phase_judge is 'openai', but phase_judge_model_id is not given; pass "
                "--policy.phase_judge_model_id=NAME, one of those that the endpoint's /models lists"
            )
        if self.phase_judge_api_base is None:
            return
        if self.phase_judge != "openai":
            raise ValueError(
                f"phase_judge_api_base is for phase_judge 'openai', got {self.phase_judge!r}; pass "
                "--policy.phase_judge=openai too, or leave it out"
            )
        address = urlsplit(self.phase_judge_api_base)
        plain = not (address.query or address.fragment or "@" in address.netloc)
        if address.scheme not in ("http", "https") or not address.hostname or not plain:
            raise ValueError(
                "phase_judge_api_base is no plain http:// or https:// address (without user, password or "
                "query, which would be logged); pass e.g. http://localhost:8000/v1, and a key in the "
                "environment variable OPENSPM_JUDGE_API_KEY"
            )

    def set_dataset_feature_metadata(self, features: Mapping[str, Any]) -> None:
        """Take the layouts from the dataset's feature names where they were not given. Called by LeRobot."""
        self.state_layout = self.state_layout or feature_names(features.get(OBS_STATE, {}).get("names"))
        self.action_layout = self.action_layout or feature_names(features.get(ACTION, {}).get("names"))

    def make_segmenter(self) -> Segmenter | None:
        """What finds the objects' masks; None where the demonstrations teach objects' looks.

        Raises:
            PerceptionError: It cannot be used.
        """
        if self.segmentation == "demonstrations":
            return None
        from lerobot_openspm.perception.segmentation.make import make_segmenter

        weights, labels = self.segmentation_weights or (), self.mask_labels or {}
        return make_segmenter(self.segmentation, labels, weights, str(self.device))

    def layouts(self) -> tuple[VectorLayout, VectorLayout]:
        """Layouts of state and action. Raises LayoutError when names are missing or make no sense."""
        state = parse_layout(self.state_layout or [], "state", self.state_rotation)  # type: ignore[arg-type]
        action = parse_layout(self.action_layout or [], "action", self.action_rotation)  # type: ignore[arg-type]
        return state, action

    @property
    def control_settings(self) -> ControlSettings:
        """The options that say how key poses are followed."""
        return ControlSettings(**{name: getattr(self, name) for name in ControlSettings.__dataclass_fields__})

    @property
    def transfer_limits(self) -> TransferLimits:
        """The bounds of the checks on transferred key poses."""
        return TransferLimits(**{name: getattr(self, name) for name in TransferLimits.__dataclass_fields__})

    @property
    def score_weights(self) -> ScoreWeights:
        """The weights of retrieval."""
        return ScoreWeights(self.weight_semantic, self.weight_geometric, self.weight_quality)

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
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay, grad_clip_norm=1.0)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        """Cosine decay; LeRobot scales it to the number of training steps."""
        return CosineDecayWithWarmupSchedulerConfig(
            peak_lr=self.optimizer_lr,
            decay_lr=self.optimizer_lr / 50,
            num_warmup_steps=self.scheduler_warmup_steps,
            num_decay_steps=self.scheduler_decay_steps,
        )

    @property
    def observation_delta_indices(self) -> None:
        """One observation at a time."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """None: chunks come from the mined segments, which end at key poses; the loader's run across them."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """No rewards are used."""
        return None


def _require_choice(name: str, got: str, expected: tuple[str, ...]) -> None:
    if got not in expected:
        raise ValueError(f"{name} is {got!r}, expected one of {', '.join(expected)}")


def feature_names(names: Any) -> list[str] | None:
    """Feature names as a list; LeRobot datasets also write them as ``{"motors": [...]}``."""
    if isinstance(names, Mapping):
        names = [name for group in names.values() for name in group]
    return [str(name) for name in names] if names else None
