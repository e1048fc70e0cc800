"""Segmentation by Grounding DINO, which finds boxes of a phrase, and SAM 2.1, which finds the masks in them.

Smaller than SAM 3, and the weights need no permission.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.segmentation.instances import check_query, distinct_instances
from lerobot_openspm.perception.segmentation.pretrained import load
from lerobot_openspm.types import Segmentation, View

DETECTOR_WEIGHTS = "IDEA-Research/grounding-dino-tiny"
MASK_WEIGHTS = "facebook/sam2.1-hiera-tiny"
# What the detector's authors take.
MIN_CONFIDENCE = 0.35


class GroundedSam2Segmenter:
    """Grounding DINO and SAM 2.1 through `transformers`. An instance's confidence is its box's.

    The detector reads image and phrase together, once per view and phrase, so that no phrase changes what is
    found of another; SAM 2.1 encodes an image once.

    Args:
        detector: ``transformers.GroundingDinoForObjectDetection`` in evaluation mode.
        detector_processor: Its ``transformers.GroundingDinoProcessor``.
        mask_model: ``transformers.Sam2Model`` in evaluation mode.
        mask_processor: Its ``transformers.Sam2Processor``.
        min_confidence: Boxes below are left out.
    """

    def __init__(
        self,
        detector: Any,
        detector_processor: Any,
        mask_model: Any,
        mask_processor: Any,
        min_confidence: float = MIN_CONFIDENCE,
    ) -> None:
        self._detector, self._detector_processor = detector, detector_processor
        self._mask_model, self._mask_processor = mask_model, mask_processor
        self._min_confidence = min_confidence

    @classmethod
    def from_pretrained(
        cls, detector: str = DETECTOR_WEIGHTS, masks: str = MASK_WEIGHTS, device: str = "cpu"
    ) -> GroundedSam2Segmenter:
        """Load weights from the Hugging Face Hub or from folders.

        Raises:
            PerceptionError: transformers, the device or the weights are missing, or a checkpoint lacks some
                of its weights.
        """
        finder = load(detector, "GroundingDinoForObjectDetection", "GroundingDinoProcessor", device)
        cutter = load(masks, "Sam2Model", "Sam2Processor", device)
        return cls(*finder, *cutter)

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
        found: dict[str, dict[str, tuple[Segmentation, ...]]] = {phrase: {} for phrase in wanted}
        with torch.inference_mode():
            for camera, view in views.items():
                boxes = {phrase: self._detect(view, phrase) for phrase in wanted}
                for phrase, instances in self._cut_out(view, boxes).items():
                    found[phrase][camera] = instances
        return found

    def _detect(self, view: View, phrase: str) -> tuple[Array, Array]:
        """Boxes ``(n, 4)`` of a phrase, u_min, v_min, u_max, v_max in pixels, and confidences ``(n,)``."""
        # The detector was trained on lower case, and on a full stop after each phrase.
        text = " ".join(phrase.lower().replace(".", " ").split()) + "."
        inputs = self._detector_processor(images=view.image, text=text, return_tensors="pt")
        longest = self._detector.config.max_text_len
        if inputs.input_ids.shape[1] > longest:
            raise PerceptionError(
                f"the phrase {phrase!r} has {inputs.input_ids.shape[1]} tokens, Grounding DINO takes "
                f"{longest}; shorten it"
            )
        inputs = inputs.to(self._detector.device, self._detector.dtype)
        height, width = view.image.shape[:2]
        (result,) = self._detector_processor.post_process_grounded_object_detection(
            self._detector(**inputs),
            inputs.input_ids,
            threshold=self._min_confidence,
            target_sizes=[(height, width)],
        )
        corners = result["boxes"].float().cpu().numpy().astype(float)
        corners = np.clip(corners, 0, [width, height, width, height])
        # Boxes that lie wholly outside have no inside left.
        inside = ((corners[:, 2:] - corners[:, :2]) >= 1).all(axis=1)
        return corners[inside], result["scores"].float().cpu().numpy().astype(float)[inside]

    def _cut_out(
        self, view: View, boxes: Mapping[str, tuple[Array, Array]]
    ) -> dict[str, tuple[Segmentation, ...]]:
        if not any(len(corners) for corners, _ in boxes.values()):
            return dict.fromkeys(boxes, ())
        pixels = self._mask_processor(images=view.image, return_tensors="pt").pixel_values
        encoded = self._mask_model.get_image_embeddings(
            pixels.to(self._mask_model.device, self._mask_model.dtype)
        )
        return {
            phrase: distinct_instances(self._masks(encoded, corners, view), confidences)
            for phrase, (corners, confidences) in boxes.items()
        }

    def _masks(self, encoded: Any, corners: Array, view: View) -> np.ndarray:
        """Masks ``(n, H, W)`` of what is in the boxes ``(n, 4)``."""
        size = view.image.shape[:2]
        if len(corners) == 0:
            return np.zeros((0, *size), bool)
        prompt = self._mask_processor(
            original_sizes=[list(size)], input_boxes=[corners.tolist()], return_tensors="pt"
        )
        output = self._mask_model(
            image_embeddings=encoded,
            input_boxes=prompt.input_boxes.to(self._mask_model.device, self._mask_model.dtype),
            multimask_output=False,
        )
        (masks,) = self._mask_processor.post_process_masks(output.pred_masks, [list(size)])
        return masks[:, 0].cpu().numpy().astype(bool)
