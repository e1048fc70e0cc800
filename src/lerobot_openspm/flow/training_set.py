"""The training samples of the flow model as tensors, and how they are drawn."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_openspm.flow.samples import SegmentFrames, action_scale, conditions_and_chunks
from lerobot_openspm.types import Conditioning


class TrainingSet:
    """Conditions and chunks of every frame of every segment.

    Args:
        frames: The demonstrated frames, looked up by their dataset index.
        perturbed: Perturbed copies of them, drawn at random only.
        allowed: Episodes to draw from at random; held-out ones can only be looked up.
        starts: Dataset index of each episode's first frame, ascending.
        conditioning: How conditions and actions are expressed.
    """

    def __init__(
        self,
        frames: SegmentFrames,
        perturbed: list[SegmentFrames],
        allowed: NDArray[np.int64],
        starts: NDArray[np.int64],
        conditioning: Conditioning,
    ):
        copies = [frames, *perturbed]
        encoded = [conditions_and_chunks(copy, conditioning) for copy in copies]
        conditions, chunks = (np.concatenate(parts) for parts in zip(*encoded, strict=True))
        self._conditions = torch.as_tensor(conditions, dtype=torch.float32)
        self._chunks = torch.as_tensor(chunks, dtype=torch.float32)
        drawable = np.isin(np.concatenate([copy.episode for copy in copies]), allowed)
        self.action_scale = torch.as_tensor(action_scale(chunks[drawable]), dtype=torch.float32)
        # Frames of short phases, in which contact is made, are drawn more often.
        phase = np.concatenate([copy.query.phase for copy in copies])
        counts = np.bincount(phase[drawable], minlength=int(phase.max()) + 1)
        weights = np.where(drawable, 1.0 / np.sqrt(np.maximum(counts[phase], 1)), 0.0)
        self._weights = torch.as_tensor(weights, dtype=torch.float32)
        self._starts = torch.as_tensor(starts)
        # Rows by ascending dataset index, and those indices.
        self._index, self._rows = torch.as_tensor(frames.index).sort()

    def draw(self, index: Tensor, draws: int, training: bool) -> tuple[Tensor, Tensor]:
        """Samples for a batch of frames: `draws` for each, the first of them the frame itself.

        A frame outside all segments (a pause, or after the last key pose) is replaced: in training by a
        random sample, else by the last frame of a segment before it in its episode, or the first one after.

        Args:
            index: Dataset index ``(b,)``.
            draws: Samples per frame.
            training: Whether replacements are drawn at random.

        Returns:
            Conditions ``(b * draws, condition_dim)`` and chunks ``(b * draws, H, 7)``, frame by frame.
        """
        index = index.cpu().flatten()
        before = (torch.searchsorted(self._index, index, right=True) - 1).clamp(min=0)
        start = self._starts[(torch.searchsorted(self._starts, index, right=True) - 1).clamp(min=0)]
        before = torch.where(self._index[before] < start, before + 1, before).clamp(max=len(self._rows) - 1)
        rows = self._rows[before]
        if training:
            rows = torch.where(self._index[before] == index, rows, self._sample(len(rows)))
        others = self._sample(len(rows) * (draws - 1)).view(len(rows), draws - 1)
        rows = torch.cat([rows[:, None], others], dim=1).flatten()
        return self._conditions[rows], self._chunks[rows]

    def _sample(self, n: int) -> Tensor:
        return (
            torch.multinomial(self._weights, n, replacement=True) if n else torch.zeros(0, dtype=torch.long)
        )
