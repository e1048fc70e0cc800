"""A chat model behind an OpenAI-compatible endpoint, such as `vllm serve` or `transformers serve` gives."""

from __future__ import annotations

import base64
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import httpx

from lerobot_openspm.errors import JudgementError
from lerobot_openspm.mining.phase_labels.cutoff import Cutoff
from lerobot_openspm.mining.phase_labels.prompt import Prompt
from lerobot_openspm.mining.phase_labels.types import Picture

# lerobot-annotate's default.
API_BASE = "http://localhost:8000/v1"
API_KEY_VARIABLE = "OPENSPM_JUDGE_API_KEY"
MAX_ANSWER_BYTES = 1_000_000
MAX_ANSWER_TOKENS = 4096
MAX_CONNECT_S = 5.0
JPEG_QUALITY = 90
# Of the codes with which servers say that they know no schemas.
NO_SCHEMA = (400, 415, 422, 501)
BUSY = (429, 500, 502, 503, 504)


class _TryAgainError(JudgementError):
    """What may pass."""


@dataclass(frozen=True)
class Patience:
    """How long and how often to ask.

    Attributes:
        timeout_s: For one question, all attempts together.
        attempts: How often a question is asked at most. One that took too long is not asked again.
        backoff_s: Wait before the second attempt; it doubles from one to the next.
    """

    timeout_s: float = 60.0
    attempts: int = 3
    backoff_s: float = 0.5


class ChatEndpoint:
    """Asks one model of one server.

    Args:
        api_base: Where it is, up to and with ``/v1``.
        model_id: The model's name there.
        patience: How long and how often to ask.
        sleep: Waits, in seconds.

    An API key is taken from the environment variable :data:`API_KEY_VARIABLE` alone, and goes nowhere but
    into the request's header. Redirects are not followed, so it reaches no other server.
    """

    def __init__(
        self,
        api_base: str,
        model_id: str,
        patience: Patience | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._url = api_base.rstrip("/") + "/chat/completions"
        self._patience, self._sleep = patience or Patience(), sleep
        self._key = os.environ.get(API_KEY_VARIABLE, "")
        self._with_schema = True
        # Each request connects anew, so that its cutoff knows its connection.
        self._http = httpx.Client(limits=httpx.Limits(max_keepalive_connections=0))
        self.model_id = model_id

    def complete(self, prompt: Prompt) -> str:
        """The model's answer.

        Raises:
            JudgementError: The server is gone, too slow, refuses, or says what is no answer.
        """
        deadline = time.monotonic() + self._patience.timeout_s
        for attempt in range(1, self._patience.attempts + 1):
            try:
                return self._ask(prompt, deadline)
            except _TryAgainError as error:
                wait_s = self._patience.backoff_s * 2 ** (attempt - 1)
                if attempt == self._patience.attempts or time.monotonic() + wait_s >= deadline:
                    raise JudgementError(f"{error}, {attempt} times") from error
                self._sleep(wait_s)
        raise JudgementError(f"{self._url} was not asked: attempts is {self._patience.attempts}")

    def _ask(self, prompt: Prompt, deadline: float) -> str:
        status, body = self._post(self._request(prompt), deadline)
        if self._with_schema and status in NO_SCHEMA:
            self._with_schema = False
            status, body = self._post(self._request(prompt), deadline)
        if status != 200:
            kind = _TryAgainError if status in BUSY else JudgementError
            raise kind(f"{self._url} answered with code {status}: {self._shown(body)}")
        try:
            content = json.loads(body)["choices"][0]["message"]["content"]
        except (ValueError, RecursionError, KeyError, IndexError, TypeError) as error:
            raise JudgementError(f"{self._url} gave no chat completion: {self._shown(body)}") from error
        if not isinstance(content, str) or not content:
            raise JudgementError(f"{self._url} gave a completion without text: {self._shown(body)}")
        return content

    def _post(self, request: Mapping[str, Any], deadline: float) -> tuple[int, bytes]:
        """Status and body of one request. What a body is longer than, or comes later than, is not read."""
        left_s = max(deadline - time.monotonic(), 0.001)
        timeout = httpx.Timeout(left_s, connect=min(left_s, MAX_CONNECT_S))
        # Unpacked, a packed body has no bounds.
        headers = {"Accept-Encoding": "identity"}
        if self._key:
            headers["Authorization"] = f"Bearer {self._key}"
        with Cutoff(left_s) as cutoff:
            try:
                answer = self._read(request, headers, timeout, cutoff)
            except httpx.TimeoutException as error:
                raise JudgementError(self._too_slow()) from error
            except (httpx.TransportError, httpx.InvalidURL) as error:
                if cutoff.passed:
                    raise JudgementError(self._too_slow()) from error
                why = f"{type(error).__name__}: {error}"
                raise _TryAgainError(f"{self._url} could not be asked ({why})") from error
            if cutoff.passed:  # what has no length ends, cut off, like a whole one
                raise JudgementError(self._too_slow())
            return answer

    def _read(
        self, request: Mapping[str, Any], headers: Mapping[str, str], timeout: httpx.Timeout, cutoff: Cutoff
    ) -> tuple[int, bytes]:
        body = bytearray()
        ask = self._http.stream(
            "POST", self._url, json=request, headers=headers, timeout=timeout,
            extensions={"trace": cutoff.trace},
        )  # fmt: skip
        with ask as response:
            for piece in response.iter_raw():
                body += piece
                if len(body) > MAX_ANSWER_BYTES:
                    raise JudgementError(f"{self._url} answered with more than {MAX_ANSWER_BYTES} bytes")
            return response.status_code, bytes(body)

    def _too_slow(self) -> str:
        return f"{self._url} took longer than {self._patience.timeout_s:g} s"

    def _request(self, prompt: Prompt) -> dict[str, Any]:
        content: list[dict[str, Any]] = []
        for caption, picture in prompt.pictures:
            content.append({"type": "text", "text": caption})
            content.append({"type": "image_url", "image_url": {"url": _data_url(picture)}})
        content.append({"type": "text", "text": prompt.text})
        request: dict[str, Any] = {
            "model": self.model_id,
            "messages": [{"role": "user", "content": content}],
            "temperature": 0,
            "max_tokens": MAX_ANSWER_TOKENS,
        }
        if self._with_schema:
            schema = {"name": "answer", "strict": True, "schema": prompt.schema}
            request["response_format"] = {"type": "json_schema", "json_schema": schema}
        return request

    def _shown(self, body: bytes) -> str:
        """The beginning of what a server said, without the key that it may have repeated."""
        text = body.decode(errors="replace")
        text = text.replace(self._key, "***") if self._key else text
        return repr(text[:200])


def _data_url(picture: Picture) -> str:
    _, jpeg = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()
