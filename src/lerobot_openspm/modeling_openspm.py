"""The policy: mines its memory when it is made for training, learns the flow model, acts by both."""

from __future__ import annotations

import logging
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from lerobot_openspm.checkpoint import checkpoint_folder, load_memory
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.control.checks import TransferLimits
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.control.planning_context import PlanningContext
from lerobot_openspm.control.strategies import ControlSettings
from lerobot_openspm.errors import DatasetError, MemoryFormatError, OpenSPMError
from lerobot_openspm.flow.condition import CONDITION_DIM, Query, encode, to_world_frame
from lerobot_openspm.flow.network import VelocityField
from lerobot_openspm.flow.training_set import TrainingSet
from lerobot_openspm.language.lexicon import read_lexicon
from lerobot_openspm.language.names import NameSimilarity, names_from
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.indexed_entries import indexed
from lerobot_openspm.memory.memory import Memory, write_memory
from lerobot_openspm.perception.observation import Observation, split_batch
from lerobot_openspm.perception.pipeline import Perception
from lerobot_openspm.types import Hand, Segmenter

if TYPE_CHECKING:
    from lerobot_openspm.teaching import Lesson

logger = logging.getLogger(__name__)

# Of checkpoints that do not say how often their robot acts.
DEFAULT_CONTROL_HZ = 20.0


@dataclass
class RunningEpisode:
    """One environment: what decides there, through what it looks, whether its outcome was reported."""

    controller: EpisodeController
    perception: Perception
    is_reported: bool = False


class OpenSPMPolicy(PreTrainedPolicy):
    """OpenSPM: a memory of key poses, carried over to the scene, and a flow model between them."""

    config_class = OpenSPMConfig  # pyright: ignore[reportAssignmentType]  (LeRobot declares None)
    name = "openspm"  # pyright: ignore[reportAssignmentType]

    def __init__(
        self,
        config: OpenSPMConfig,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: Any | None = None,
        **kwargs: Any,
    ):
        """Make a policy, and mine its memory if there is a dataset to mine.

        Args:
            config: The configuration.
            dataset_stats: Not used: poses are not normalised.
            dataset_meta: Metadata of the dataset to mine and to learn from; None for a policy that is about
                to be loaded.
            kwargs: What else LeRobot passes to every policy.
        """
        super().__init__(config)
        config.validate_features()
        self.config: OpenSPMConfig = config
        self.flow = VelocityField(CONDITION_DIM[config.conditioning], config.chunk_size, 7)
        self.memory: Memory | None = None
        self._training_set: TrainingSet | None = None
        self._entries: tuple[Sequence[MemoryEntry], Sequence[MemoryEntry]] | None = None
        if dataset_meta is not None:
            _ = self.names  # what cannot be used is an error now, not at the first observation
            config.control_hz = config.control_hz or float(dataset_meta.fps)
            from lerobot_openspm.training import learn

            self.memory, self._training_set = learn(dataset_meta, config, None, self.segmenter)
            self.flow.action_scale.copy_(self._training_set.action_scale)
        self.reset()

    # Acting. `select_action` reads top to bottom: observe, ask for chunks where needed, act.

    def reset(self) -> None:
        """Forget the running episodes."""
        self.episodes: list[RunningEpisode] = []

    @property
    def outcomes(self) -> list[bool | None]:
        """Whether each running episode is seen to have done what was asked; None where that is not known."""
        return [episode.controller.succeeded for episode in self.episodes]

    def report_outcomes(self, successes: Sequence[bool | None] | None = None) -> None:
        """Tell how the running episodes ended, before the next :meth:`reset`; the memory learns from it.

        The quality of the entries that each episode was acted by follows, for the episodes to come and in
        what is saved from now on. An episode counts once, however often it is reported.

        Args:
            successes: For every environment, in the order of the observations, whether its episode succeeded;
                None where that is not known. Without it what the policy has seen itself counts:
                :attr:`outcomes`.

        Raises:
            OpenSPMError: There are more or fewer environments.
        """
        successes = self.outcomes if successes is None else successes
        if len(successes) != len(self.episodes):
            raise OpenSPMError(
                f"got {len(successes)} outcomes, but {len(self.episodes)} episodes are running; report one "
                "for every environment, after acting and before reset()"
            )
        outcomes = []
        for episode, success in zip(self.episodes, successes, strict=True):
            if success is not None and not episode.is_reported:
                episode.is_reported = True
                outcomes += [(entry, success) for entry in episode.controller.planner.used]
        if outcomes:
            self.memory = self.require_memory().with_outcomes(outcomes)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Choose one action ``(b, action_dim)`` for every environment of a batch of observations."""
        return self._encode(self.act(split_batch(batch, self.config.layouts()[0])))

    @torch.no_grad()
    def act(self, observations: Sequence[Observation]) -> np.ndarray:
        """Choose one canonical action ``(b, 7)`` for every environment; images are looked at when needed."""
        self.eval()
        actions = []
        for controller, hand in self._observe(observations):
            action = controller.next_action(hand)
            if action is None:
                chunk = self._chunk(controller, controller.query(hand))
                controller.executor.push_chunk(chunk[: self.config.n_action_steps])
                action = controller.next_action(hand)
            actions.append(action)
        return np.stack(actions)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """What the next actions ``(b, chunk_size, action_dim)`` would be if no new observation came.

        The policy stays as it is: episodes go on, with :meth:`select_action`, as if nobody had asked.
        """
        with self._looking_ahead():
            chunks = []
            for controller, hand in self._observe(split_batch(batch, self.config.layouts()[0])):
                chunk = []
                while len(chunk) < self.config.chunk_size:
                    action = controller.next_action(hand)
                    if action is None:
                        controller.executor.push_chunk(self._chunk(controller, controller.query(hand)))
                    else:
                        chunk.append(action)
                chunks.append(chunk)
            return self._encode(np.stack(chunks))

    @contextmanager
    def _looking_ahead(self) -> Generator[None]:
        """Act on copies of the running episodes; at the end those that were running are back."""
        running, is_training = self.episodes, self.training
        # Entries, models and a segmenter's weights are large and never change: the copies share them.
        shared = [self.memory, self.segmenter, *(one.perception.memory for one in running)]
        for controller in (one.controller for one in running):
            entries = [*controller.planner.used, *(one.entry for one in controller.planner.ranked)]
            shared += [controller.planner.parts, *entries]
        try:
            self.episodes = deepcopy(running, {id(one): one for one in shared})
            self.eval()
            yield
        finally:
            self.episodes = running
            self.train(is_training)

    def _observe(self, observations: Sequence[Observation]) -> list[tuple[EpisodeController, Hand]]:
        """Each environment's controller, brought up to its observation, and its hand."""
        self._begin_episodes(observations)
        for episode, observation in zip(self.episodes, observations, strict=True):
            detect = partial(episode.perception.detect, observation)
            episode.controller.observe(observation.hand, detect)
        return [
            (episode.controller, observation.hand)
            for episode, observation in zip(self.episodes, observations, strict=True)
        ]

    def _encode(self, actions: np.ndarray) -> Tensor:
        """Actions ``(..., 7)`` in the robot's own layout."""
        vectors = self.config.layouts()[1].encode_actions(actions)
        return torch.as_tensor(vectors, dtype=torch.float32, device=self.config.device)

    def _begin_episodes(self, observations: Sequence[Observation]) -> None:
        """Begin an episode wherever there is none, or its instruction is new."""
        if len(self.episodes) != len(observations):
            self.episodes = [self._new_episode(observation) for observation in observations]
        for i, observation in enumerate(observations):
            if self.episodes[i].controller.instruction != observation.instruction:
                self.episodes[i] = self._new_episode(observation)

    def _new_episode(self, observation: Observation) -> RunningEpisode:
        memory, config = self.require_memory(), self.config
        # Episodes share the index, which is made anew when the memory was replaced.
        if self._entries is None or self._entries[0] is not memory.entries:
            self._entries = memory.entries, indexed(memory.entries)
        context = PlanningContext(
            self._entries[1], memory.yaw_periods, memory.robot,
            limits=TransferLimits(config.reach_margin_m, config.min_clearance_m),
            settings=ControlSettings(config.execution),
            tracking=config.tracking, step_s=self.step_s, names=self.names,
        )  # fmt: skip
        controller = EpisodeController(
            context, observation.instruction, observation.fingerprint(), config.noise_seed
        )
        return RunningEpisode(controller, Perception(memory, config.hand_radius_m, self.segmenter))

    @property
    def step_s(self) -> float:
        """Seconds that a control step takes."""
        return 1 / (self.config.control_hz or DEFAULT_CONTROL_HZ)

    @cached_property
    def segmenter(self) -> Segmenter | None:
        """What finds the objects' masks, made when it is first needed; None where their colours do."""
        return self.config.make_segmenter()

    @cached_property
    def names(self) -> NameSimilarity:
        """What says which names mean the same thing: the lexicon, or with embeddings beside it."""
        return names_from(self.config.name_embeddings, read_lexicon(self.config.lexicon))

    def _chunk(self, controller: EpisodeController, query: Query) -> np.ndarray:
        """Generate a chunk ``(chunk_size, 7)`` in the world. Episodes go one by one, so batches act alike."""
        condition = encode(query, self.config.conditioning)
        noise = controller.noise((1, self.config.chunk_size, 7))
        device = self.flow.action_scale.device
        chunk = self.flow.sample(
            torch.as_tensor(condition[None], dtype=torch.float32, device=device),
            torch.as_tensor(noise, dtype=torch.float32, device=device),
            self.config.num_inference_steps,
        )
        actions = to_world_frame(
            chunk[0].cpu().numpy().astype(float), query.T_world_target, self.config.conditioning
        )
        # The fingers do what the key pose says; the flow model's last number only says it less surely.
        actions[:, 6] = self.require_memory().robot.command(bool(query.closed))
        return actions

    # Learning.

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Flow-matching loss of the batch's frames, and of others drawn beside them while training.

        Args:
            batch: Needs ``index`` alone; conditions and chunks were kept from mining.
            reduction: "mean", or "none" for one loss per frame of the batch ``(b,)``.
        """
        if self._training_set is None:
            raise DatasetError(
                "this policy was made without a dataset and cannot be trained; pass dataset_meta, as "
                "lerobot-train does"
            )
        draws = self.config.samples_per_frame if self.training else 1
        condition, actions = self._training_set.draw(batch["index"], draws, self.training)
        condition, actions = condition.to(self.flow.action_scale), actions.to(self.flow.action_scale)
        noise = torch.randn_like(actions)
        time = torch.rand(len(actions), device=actions.device)
        losses = self.flow.loss(condition, actions, noise, time).view(len(batch["index"]), -1).mean(dim=1)
        loss = losses if reduction == "none" else losses.mean()
        return loss, {"flow_loss": float(losses.mean().detach())}

    def get_optim_params(self) -> Any:
        """The flow model's parameters."""
        return self.parameters()

    def teach(self, dataset_meta: Any, episodes: Sequence[int] | None = None) -> Lesson:
        """Append demonstrations to the memory; no weight changes. Running episodes go on with what they know.

        Args and errors are those of :func:`lerobot_openspm.teaching.teach`; after one nothing has changed.
        """
        from lerobot_openspm.teaching import teach

        known = self.require_memory()
        self.memory, lesson = teach(known, self.config, dataset_meta, episodes, self.segmenter)
        return lesson

    # Persistence: the memory travels with the weights.

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        memory = self.require_memory()  # before anything is written
        super()._save_pretrained(save_directory, state_dict=state_dict)
        # The calibration travels as a file of the checkpoint, the user's own words in its configuration.
        saved = replace(self.config.without_places(), lexicon=self.names.lexicon.added or None)
        saved._save_pretrained(Path(save_directory))
        write_memory(memory, Path(save_directory))

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: Any | None = None,
        strict: bool = True,
        force_download: bool = False,
        token: str | bool | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
        revision: str | None = None,
        **kwargs: Any,
    ) -> OpenSPMPolicy:
        """Load weights, memory and calibration from a directory or from the Hub.

        With `dataset_meta`, training goes on: the memory is kept, appended to or rebuilt, as
        ``config.memory_update`` says.

        Raises:
            MemoryFormatError: The checkpoint has no memory, or a damaged or newer one.
        """
        directory = checkpoint_folder(
            pretrained_name_or_path, revision, force_download=force_download, token=token,
            cache_dir=cache_dir, local_files_only=local_files_only,
        )  # fmt: skip
        policy = super().from_pretrained(directory, config=config, strict=strict, **kwargs)
        policy._attach(directory, dataset_meta)
        return policy

    def _attach(self, directory: Path, dataset_meta: Any | None) -> None:
        """Give a freshly loaded policy its memory, and its training set when training goes on."""
        is_kept = self.config.memory_update == "keep" or dataset_meta is None
        self.memory = load_memory(directory, self.config, is_kept)
        _ = self.segmenter, self.names  # what cannot be used is an error now, not at the first observation
        if dataset_meta is not None:
            from lerobot_openspm.training import learn

            self.memory, self._training_set = learn(dataset_meta, self.config, self.memory, self.segmenter)

    def require_memory(self) -> Memory:
        """What was mined. Raises MemoryFormatError when nothing was."""
        if self.memory is None:
            raise MemoryFormatError(
                "this policy has no memory; train it with lerobot-train --policy.type=openspm, or load a "
                "checkpoint with --policy.path"
            )
        return self.memory
