"""Segmentation by SAM 3, which finds all instances of a phrase in an image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation.instances import check_query, distinct_instances
from lerobot_openspm.perception.segmentation.pretrained import load
from lerobot_openspm.types import Segmentation, View

WEIGHTS = "facebook/sam3"
# What the model's authors take.
MIN_CONFIDENCE = 0.5


class Sam3Segmenter:
    """SAM 3 through `transformers`. An image is encoded once and queried once per phrase.

    Args:
        model: ``transformers.Sam3Model`` in evaluation mode.
        processor: Its ``transformers.Sam3Processor``.
        min_confidence: Instances below are left out.
    """

    def __init__(self, model: Any, processor: Any, min_confidence: float = MIN_CONFIDENCE) -> None:
        self._model = model
        self._processor = processor
        self._min_confidence = min_confidence

    @classmethod
    def from_pretrained(cls, name: str = WEIGHTS, device: str = "cpu") -> Sam3Segmenter:
        """Load weights from the Hugging Face Hub or a folder.

        Raises:
            PerceptionError: transformers, the device, the weights or the permission to use them are missing,
                or the checkpoint lacks some of the weights.
        """
        return cls(*load(name, "Sam3Model", "Sam3Processor", device))

    def segment(
        self, views: Mapping[str, View], phrases: Sequence[str]
    ) -> dict[str, dict[str, tuple[Segmentation, ...]]]:
        """See :class:`lerobot_openspm.types.Segmenter`.

        Raises:
            PerceptionError: A phrase is empty or too long.
            ObservationError: A view is malformed.
        """
        import torch

        wanted = check_query(views, phrases)
        if not wanted:
            return {}
        found: dict[str, dict[str, tuple[Segmentation, ...]]] = {phrase: {} for phrase in wanted}
        with torch.inference_mode():
            prompts = {phrase: self._encode_text(phrase) for phrase in wanted}
            for camera, view in views.items():
                pixels = self._processor(images=view.image, return_tensors="pt").pixel_values
                pixels = pixels.to(self._model.device, self._model.dtype)
                encoded = self._model.get_vision_features(pixels)
                for phrase, prompt in prompts.items():
                    found[phrase][camera] = self._instances(encoded, prompt, view)
        return found

    def _encode_text(self, phrase: str) -> dict[str, Any]:
        """A phrase as the model takes it: features ``(1, tokens, width)`` and which tokens are text."""
        tokens = self._processor(text=phrase, return_tensors="pt").to(self._model.device)
        longest = self._model.config.text_config.max_position_embeddings
        if tokens.input_ids.shape[1] > longest:
            raise PerceptionError(
                f"the phrase {phrase!r} has {tokens.input_ids.shape[1]} tokens, SAM 3 takes {longest}; "
                "shorten it"
            )
        features = self._model.get_text_features(tokens.input_ids, tokens.attention_mask).pooler_output
        return {"text_embeds": features, "attention_mask": tokens.attention_mask}

    def _instances(self, encoded: Any, prompt: dict[str, Any], view: View) -> tuple[Segmentation, ...]:
        output = self._model(vision_embeds=encoded, **prompt)
        (result,) = self._processor.post_process_instance_segmentation(
            output, threshold=self._min_confidence, target_sizes=[view.image.shape[:2]]
        )
        masks = result["masks"].cpu().numpy().astype(bool)
        return distinct_instances(masks, result["scores"].float().cpu().numpy().astype(np.float64))
