"""The policy: mines its memory when it is made for training, learns the flow model, acts by both."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from lerobot_openspm.checkpoint import checkpoint_folder, load_memory
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.control.controller import EpisodeController
from lerobot_openspm.episodes import RunningEpisode, new_episode
from lerobot_openspm.errors import DatasetError, MemoryFormatError, OpenSPMError
from lerobot_openspm.flow.condition import CONDITION_DIM, encode, to_world_frame
from lerobot_openspm.flow.network import VelocityField
from lerobot_openspm.flow.training_set import TrainingSet
from lerobot_openspm.language.lexicon import read_lexicon
from lerobot_openspm.language.names import NameSimilarity, names_from
from lerobot_openspm.memory.entry import MemoryEntry
from lerobot_openspm.memory.indexed_entries import indexed
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.perception.observation import Observation, split_batch
from lerobot_openspm.types import Hand, Segmenter
from lerobot_openspm.workplaces import choose, folders, write

if TYPE_CHECKING:
    from lerobot_openspm.teaching import Lesson


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
        self.elsewhere: tuple[Memory, ...] = ()  # those of other workplaces
        self._training_set: TrainingSet | None = None
        self._entries: dict[int, tuple[Sequence[MemoryEntry], Sequence[MemoryEntry]]] = {}
        if dataset_meta is not None:
            _ = self.names  # what cannot be used is an error now, not at the first observation
            config.control_hz = config.control_hz or float(dataset_meta.fps)
            training_set = self._learn(dataset_meta)
            self.flow.action_scale.copy_(training_set.action_scale)
        self.reset()

    # Acting. Top to bottom: look where the controller wants it, ask for a chunk where it is needed, act.

    def reset(self) -> None:
        """Forget the running episodes."""
        self.episodes: list[RunningEpisode] = []

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Choose one action ``(b, action_dim)`` for every environment of a batch of observations."""
        return self._encode(self.act(split_batch(batch, self.config.layouts()[0]))[:, 0])

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """What the next actions ``(b, chunk_size, action_dim)`` would be if no new observation came.

        Nothing changes: episodes go on, with :meth:`select_action`, as if nobody had asked.
        """
        observations, n_steps = split_batch(batch, self.config.layouts()[0]), self.config.chunk_size
        running, is_training = self.episodes, self.training
        # Copies act. They share the memory and the segmenter, which are large and never change.
        shared = [self.segmenter, *(one.perception.memory for one in running)]
        try:
            self.episodes = deepcopy(running, {id(one): one for one in shared})
            return self._encode(self.act(observations, n_steps, n_steps))
        finally:
            self.episodes = running
            self.train(is_training)

    @torch.no_grad()
    def act(
        self, observations: Sequence[Observation], n_actions: int = 1, n_kept: int | None = None
    ) -> np.ndarray:
        """Choose the next canonical actions ``(b, n_actions, 7)`` for every environment.

        Args:
            observations: One for every environment; its images are looked at when the controller wants it.
            n_actions: How many actions to choose.
            n_kept: How many actions of every new chunk are kept; as configured if not given.
        """
        self.eval()
        self._begin_episodes(observations)
        actions = np.empty((len(observations), n_actions, 7))
        for row, (episode, observation) in enumerate(zip(self.episodes, observations, strict=True)):
            controller, hand = episode.controller, observation.hand
            robot = self.memories[episode.workplace].robot
            look = controller.advance(hand)
            while look is not None:  # twice where a part of the instruction ends and the next one begins
                detections = episode.perception.detect(
                    observation, look.names, look.expected, look.time_s, look.told_apart, look.displaced,
                    look.is_loaded,
                )  # fmt: skip
                look = controller.take_in(look, detections, hand)
            for i in range(n_actions):
                while (action := controller.executor.next_action(hand)) is None:
                    chunk = self._chunk(controller, hand)
                    controller.executor.push_chunk(chunk[: n_kept or self.config.n_action_steps])
                actions[row, i] = action
                # The next one begins where the hand should be by then.
                hand = replace(hand, T_world_ee=robot.moved(hand.T_world_ee, action))
        return actions

    def _begin_episodes(self, observations: Sequence[Observation]) -> None:
        """Begin an episode wherever there is none, or its instruction is new."""
        if len(self.episodes) != len(observations):
            self.episodes = [self._new_episode(observation) for observation in observations]
        for i, observation in enumerate(observations):
            if self.episodes[i].controller.instruction != observation.instruction:
                self.episodes[i] = self._new_episode(observation)

    def _new_episode(self, observation: Observation) -> RunningEpisode:
        i, memory, entries = self.workplace(observation)
        episode = new_episode(observation, memory, entries, self.config, self.names, self.segmenter)
        return replace(episode, workplace=i)

    def workplace(self, observation: Observation) -> tuple[int, Memory, Sequence[MemoryEntry]]:
        """At which workplace an episode begins, from 0; its memory, and its entries with their index."""
        memories = self.memories
        # Episodes share the index, which is made anew when the memory was replaced.
        for i, memory in enumerate(memories):
            if i not in self._entries or self._entries[i][0] is not memory.entries:
                self._entries[i] = memory.entries, indexed(memory.entries)
        entries = [self._entries[i][1] for i in range(len(memories))]
        i = choose(observation, memories, entries, self.names)
        return i, memories[i], entries[i]

    def _chunk(self, controller: EpisodeController, hand: Hand) -> np.ndarray:
        """Generate a chunk ``(chunk_size, 7)`` in the world. Episodes go one by one, so batches act alike."""
        query = controller.executor.query(hand)
        condition = encode(query, self.config.conditioning)[None]
        noise = controller.noise((1, self.config.chunk_size, 7))
        device = self.flow.action_scale.device
        condition, noise = (
            torch.as_tensor(array, dtype=torch.float32, device=device) for array in (condition, noise)
        )
        chunk = self.flow.sample(condition, noise, self.config.num_inference_steps)
        actions = chunk[0].cpu().numpy().astype(float)
        return to_world_frame(actions, query.T_world_target, self.config.conditioning)

    def _encode(self, actions: np.ndarray) -> Tensor:
        """Actions ``(..., 7)`` in the robot's own layout."""
        vectors = self.config.layouts()[1].encode_actions(actions)
        return torch.as_tensor(vectors, dtype=torch.float32, device=self.config.device)

    @cached_property
    def segmenter(self) -> Segmenter | None:
        """What finds the objects' masks, made when it is first needed; None where their colours do."""
        return self.config.make_segmenter()

    @cached_property
    def names(self) -> NameSimilarity:
        """What tells which names mean the same thing: the lexicon, or with embeddings beside it."""
        return names_from(self.config.name_embeddings, read_lexicon(self.config.lexicon))

    # Learning.

    @property
    def successes(self) -> list[bool | None]:
        """Whether each running episode is seen to have done what was asked; None where that is not known."""
        return [episode.controller.state.succeeded for episode in self.episodes]

    def report_successes(self, successes: Sequence[bool | None] | None = None) -> None:
        """Tell how the running episodes ended, before the next :meth:`reset`; the memory learns from it.

        The quality of the entries that each episode was acted by changes, for later episodes and in what is
        saved. A failure does not count for the parts of an instruction that were seen to be done. An episode
        counts once, however often it is reported.

        Args:
            successes: For every environment whether its episode succeeded, None where that is not known; what
                the policy has seen itself (:attr:`successes`) if not given.

        Raises:
            OpenSPMError: There are more or fewer environments.
        """
        successes = self.successes if successes is None else successes
        if len(successes) != len(self.episodes):
            raise OpenSPMError(
                f"got {len(successes)} successes, but {len(self.episodes)} episodes are running; report one "
                "for every environment, after acting and before reset()"
            )
        counted = defaultdict[int, list[tuple[MemoryEntry, bool]]](list)
        for episode, success in zip(self.episodes, successes, strict=True):
            if success is not None and not episode.is_reported:
                episode.is_reported = True
                counted[episode.workplace] += episode.controller.state.entry_successes(success)
        memories = list(self.memories)
        for i, fared in counted.items():
            memories[i] = memories[i].with_successes(fared)
        self.memory, *elsewhere = memories
        self.elsewhere = tuple(elsewhere)

    def _learn(self, dataset_meta: Any) -> TrainingSet:
        """Mine a dataset: the memory begins or goes on with it, and the flow model learns from it."""
        from lerobot_openspm.training import learn

        self.memory, self._training_set = learn(dataset_meta, self.config, self.memory, self.segmenter)
        return self._training_set

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
        noise, time = torch.randn_like(actions), torch.rand(len(actions), device=actions.device)
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
        # The calibration travels with the memory, the user's own words in the configuration.
        saved = replace(self.config.without_places(), lexicon=self.names.lexicon.added or None)
        saved._save_pretrained(Path(save_directory))
        write((memory, *self.elsewhere), Path(save_directory))

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: Any | None = None,
        strict: bool = True,
        revision: str | None = None,
        **kwargs: Any,
    ) -> OpenSPMPolicy:
        """Load weights, memory and calibration from a directory or from the Hub.

        With `dataset_meta`, training goes on: the memory is kept, appended to or rebuilt, as
        ``config.memory_update`` says. `kwargs` are LeRobot's own, those of the download among them.

        Raises:
            MemoryFormatError: The checkpoint has no memory, or a damaged or newer one.
        """
        options = ("force_download", "token", "cache_dir", "local_files_only")
        download = {option: kwargs.pop(option) for option in options if option in kwargs}
        directory = checkpoint_folder(pretrained_name_or_path, revision, **download)
        policy = super().from_pretrained(directory, config=config, strict=strict, **kwargs)
        is_kept = policy.config.memory_update == "keep" or dataset_meta is None
        policy.memory = load_memory(directory, policy.config, is_kept)
        # The options' calibration and arm are those of the first workplace.
        own = replace(policy.config, cameras=None, arm=None)
        policy.elsewhere = tuple(load_memory(other, own, True) for other in folders(directory)[1:])
        # What cannot be used is an error now, not at the first observation.
        _ = policy.segmenter, policy.names
        if dataset_meta is not None:
            policy._learn(dataset_meta)  # the loaded action scale stays: the weights were trained with it
        return policy

    @property
    def memories(self) -> tuple[Memory, ...]:
        """What was mined at each workplace."""
        return (self.require_memory(), *self.elsewhere)

    def require_memory(self) -> Memory:
        """What was mined. Raises MemoryFormatError when nothing was."""
        if self.memory is None:
            raise MemoryFormatError(
                "this policy has no memory; train it with lerobot-train --policy.type=openspm, or load a "
                "checkpoint with --policy.path"
            )
        return self.memory
