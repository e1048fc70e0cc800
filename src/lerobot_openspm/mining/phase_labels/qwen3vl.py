"""Qwen3-VL in this process, constrained by a grammar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.memory.entry import PHASES
from lerobot_openspm.mining.phase_labels.base import PhaseJudge, PhaseLabel, PhaseLabels, PhaseQuestion
from lerobot_openspm.mining.phase_labels.prompt import AS_LINES, WORDING, Prompt, phase_prompt
from lerobot_openspm.perception.segmentation.pretrained import load

WEIGHTS = "Qwen/Qwen3-VL-2B-Instruct"
MAX_NEW_TOKENS = 4096

# The alternatives for the next piece, given the pieces written so far; none at the end.
Grammar = Callable[[tuple[str, ...]], tuple[str, ...]]


@dataclass(frozen=True)
class Piece:
    """The alternative that was written at one place of a grammar.

    Attributes:
        text: Its text.
        probability: Its probability among the alternatives, given what was written before.
    """

    text: str
    probability: float


class Qwen3VL:
    """Qwen3-VL through `transformers`.

    Args:
        model: ``transformers.Qwen3VLForConditionalGeneration`` in evaluation mode.
        processor: Its ``transformers.Qwen3VLProcessor``.
        model_id: What it is called.
    """

    def __init__(self, model: Any, processor: Any, model_id: str = WEIGHTS) -> None:
        self._model, self._processor, self.model_id = model, processor, model_id

    @classmethod
    def from_pretrained(cls, name: str = WEIGHTS, device: str = "cpu") -> Qwen3VL:
        """Load weights from the Hugging Face Hub or a folder.

        Raises:
            PerceptionError: transformers, the device or the weights are missing, or some of the weights.
        """
        return cls(*load(name, "Qwen3VLForConditionalGeneration", "Qwen3VLProcessor", device), name)

    def write(self, prompt: Prompt, grammar: Grammar) -> list[Piece]:
        """Write greedily what a grammar allows.

        Raises:
            PhaseLabelError: The device's memory is too small, or the grammar did not end.
        """
        import torch
        from transformers import LogitsProcessorList

        inputs = self._inputs(prompt)
        n_prompt = inputs["input_ids"].shape[1]
        speller, measured = _Speller(self._processor.tokenizer, grammar), _Measured()
        try:
            with torch.inference_mode():
                output = self._model.generate(
                    **inputs,
                    max_new_tokens=MAX_NEW_TOKENS,
                    # The speller ends with this one, also where the model's own settings name none.
                    eos_token_id=self._processor.tokenizer.eos_token_id,
                    do_sample=False,
                    # Some releases of the family ask for one, and would vary what they repeat.
                    repetition_penalty=1.0,
                    prefix_allowed_tokens_fn=lambda _, ids: speller.allowed(ids[n_prompt:].tolist()),
                    logits_processor=LogitsProcessorList([measured]),
                )
        except torch.OutOfMemoryError as error:
            raise PhaseLabelError(f"{self.model_id} does not fit into the memory of its device") from error
        return speller.pieces(output[0, n_prompt:].tolist(), measured.steps)

    def _inputs(self, prompt: Prompt) -> Any:
        content: list[dict[str, str]] = []
        for caption, _ in prompt.pictures:
            content += [{"type": "text", "text": caption}, {"type": "image"}]
        content.append({"type": "text", "text": prompt.text})
        chat = self._processor.apply_chat_template(
            [{"role": "user", "content": content}], add_generation_prompt=True, tokenize=False
        )
        pictures = [picture for _, picture in prompt.pictures] or None
        return self._processor(text=[chat], images=pictures, return_tensors="pt").to(self._model.device)


class _Measured:
    """A logits processor that records each allowed token's probability, and changes nothing."""

    def __init__(self) -> None:
        self.steps: list[dict[int, float]] = []

    def __call__(self, input_ids: Any, scores: Any) -> Any:
        allowed = scores[0].isfinite().nonzero().flatten()
        probabilities = scores[0][allowed].float().softmax(dim=0)
        self.steps.append(dict(zip(allowed.tolist(), probabilities.tolist(), strict=True)))
        return scores


class _Speller:
    """A grammar's alternatives as tokens."""

    def __init__(self, tokenizer: Any, grammar: Grammar) -> None:
        self._tokenizer, self._grammar = tokenizer, grammar
        self._spelled: dict[str, tuple[int, ...]] = {}
        self._pieces: list[str] = []
        self._at = 0

    def allowed(self, written: list[int]) -> list[int]:
        """The tokens that may come next."""
        _, alternatives = self._read(written)
        begun = tuple(written[self._at :])
        following = {
            tokens[len(begun)]
            for tokens in map(self._spell, alternatives)
            if tokens[: len(begun)] == begun and len(tokens) > len(begun)
        }
        return sorted(following) or [self._tokenizer.eos_token_id]

    def pieces(self, written: list[int], steps: list[dict[int, float]]) -> list[Piece]:
        """What was written, each piece with the product of its tokens' probabilities.

        Raises:
            PhaseLabelError: The grammar did not end.
        """
        texts, alternatives = self._read(written)
        if alternatives:
            raise PhaseLabelError(f"the model wrote {len(written)} tokens and came to no end")
        found, at = [], 0
        for text in texts:
            tokens = self._spell(text)
            chances = [steps[at + i][token] for i, token in enumerate(tokens)]
            found.append(Piece(text, float(np.prod(chances))))
            at += len(tokens)
        return found

    def _read(self, written: list[int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The whole pieces in what was written, and the alternatives for the next one.

        Continues from the last call, because what is written only grows.
        """
        while alternatives := self._grammar(tuple(self._pieces)):
            ahead = tuple(written[self._at :])
            piece = next((a for a in alternatives if ahead[: len(self._spell(a))] == self._spell(a)), None)
            if piece is None:
                break
            self._pieces.append(piece)
            self._at += len(self._spell(piece))
        return tuple(self._pieces), alternatives

    def _spell(self, text: str) -> tuple[int, ...]:
        if text not in self._spelled:
            self._spelled[text] = tuple(self._tokenizer(text, add_special_tokens=False)["input_ids"])
        return self._spelled[text]


def qwen3vl_judge(model: Qwen3VL) -> PhaseJudge:
    """Phase labels from Qwen3-VL, with the probabilities that it gives the phases it writes."""

    def judge(question: PhaseQuestion) -> PhaseLabels:
        n = len(question.candidates)

        def lines(written: tuple[str, ...]) -> tuple[str, ...]:
            number = len(written) + 1
            return () if number > n else tuple(f"{number}: {phase}\n" for phase in PHASES)

        written = model.write(phase_prompt(question, AS_LINES), lines)
        return tuple(PhaseLabel(one.text.strip().partition(": ")[2], one.probability) for one in written)

    return PhaseJudge(f"qwen3vl {model.model_id} v{WORDING}", judge)
