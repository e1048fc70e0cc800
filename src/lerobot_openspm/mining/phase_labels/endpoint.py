"""A chat model behind an OpenAI-compatible endpoint, such as `vllm serve` or `transformers serve` gives."""

from __future__ import annotations

import asyncio
import base64
import json
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import httpx

from lerobot_openspm.errors import PhaseLabelError
from lerobot_openspm.mining.phase_labels.base import PhaseJudge, PhaseLabels, PhaseQuestion, Picture
from lerobot_openspm.mining.phase_labels.prompt import AS_JSON, WORDING, Prompt, phase_prompt, read_phases

# lerobot-annotate's default.
API_BASE = "http://localhost:8000/v1"
API_KEY_VARIABLE = "OPENSPM_JUDGE_API_KEY"
TIMEOUT_S, MAX_CONNECT_S = 60.0, 5.0
ATTEMPTS = 3
MAX_ANSWER_BYTES = 1_000_000
MAX_ANSWER_TOKENS = 4096
JPEG_QUALITY = 90
# Status codes of servers that do not know JSON schemas.
NO_SCHEMA = (400, 415, 422, 501)
BUSY = (429, 500, 502, 503, 504)


class _TryAgainError(PhaseLabelError):
    """A fault that may pass."""


class ChatEndpoint:
    """Asks one model of one server.

    The API key is read from the environment variable :data:`API_KEY_VARIABLE` and only sent in the request's
    header. Redirects are not followed, so the key reaches no other server.

    Args:
        api_base: Address of the server, up to and with ``/v1``.
        model_id: The model's name there.
        timeout_s: Limit for one question, all attempts together.
        backoff_s: Wait before the second attempt; it doubles before the third.
    """

    def __init__(
        self, api_base: str, model_id: str, timeout_s: float = TIMEOUT_S, backoff_s: float = 0.5
    ) -> None:
        self._url = api_base.rstrip("/") + "/chat/completions"
        self._timeout_s, self._backoff_s = timeout_s, backoff_s
        self._key = os.environ.get(API_KEY_VARIABLE, "")
        self._with_schema = True
        # Reading all root certificates is slow on a loaded machine, and no part of waiting for an answer.
        self._tls = httpx.create_ssl_context()
        self.model_id = model_id

    def complete(self, prompt: Prompt) -> str:
        """The model's answer.

        Raises:
            PhaseLabelError: The server is gone, too slow, refuses, or gives no completion.
        """
        # In a thread of its own, because in a notebook this one already runs an event loop.
        with ThreadPoolExecutor(1) as thread:
            return thread.submit(asyncio.run, self._complete(prompt)).result()

    async def _complete(self, prompt: Prompt) -> str:
        # Answers are not compressed: unpacked they would have no bound.
        headers = {"Accept-Encoding": "identity"}
        if self._key:
            headers["Authorization"] = f"Bearer {self._key}"
        # httpx's timeouts start again with every byte; asyncio's ends a request whatever it is doing.
        timeout = httpx.Timeout(None, connect=MAX_CONNECT_S)
        try:
            async with (
                asyncio.timeout(self._timeout_s) as limit,
                httpx.AsyncClient(headers=headers, timeout=timeout, verify=self._tls) as http,
            ):
                return await self._attempts(http, prompt, limit.when() or 0.0)
        except TimeoutError as error:
            raise PhaseLabelError(f"{self._url} took longer than {self._timeout_s:g} s") from error

    async def _attempts(self, http: httpx.AsyncClient, prompt: Prompt, deadline: float) -> str:
        """Ask until there is an answer, no attempt is left, or no time for another one."""
        attempt, wait_s = 1, self._backoff_s
        while True:
            try:
                return await self._ask(http, prompt)
            except _TryAgainError as error:
                if attempt == ATTEMPTS or asyncio.get_running_loop().time() + wait_s >= deadline:
                    raise PhaseLabelError(f"{error}, {attempt} times") from error
            await asyncio.sleep(wait_s)
            attempt, wait_s = attempt + 1, 2 * wait_s

    async def _ask(self, http: httpx.AsyncClient, prompt: Prompt) -> str:
        status, body = await self._post(http, prompt)
        if self._with_schema and status in NO_SCHEMA:
            self._with_schema = False
            status, body = await self._post(http, prompt)
        if status != 200:
            kind = _TryAgainError if status in BUSY else PhaseLabelError
            raise kind(f"{self._url} answered with code {status}: {self._shown(body)}")
        try:
            content = json.loads(body)["choices"][0]["message"]["content"]
        except (ValueError, RecursionError, KeyError, IndexError, TypeError) as error:
            raise PhaseLabelError(f"{self._url} gave no chat completion: {self._shown(body)}") from error
        if not isinstance(content, str) or not content:
            raise PhaseLabelError(f"{self._url} gave a completion without text: {self._shown(body)}")
        return content

    async def _post(self, http: httpx.AsyncClient, prompt: Prompt) -> tuple[int, bytes]:
        """Status and body of one request. A body over the limit is not read to its end."""
        body = bytearray()
        try:
            async with http.stream("POST", self._url, json=self._request(prompt)) as response:
                async for piece in response.aiter_raw():
                    body += piece
                    if len(body) > MAX_ANSWER_BYTES:
                        raise PhaseLabelError(f"{self._url} answered with more than {MAX_ANSWER_BYTES} bytes")
                return response.status_code, bytes(body)
        except (httpx.TransportError, httpx.InvalidURL) as error:
            kind = PhaseLabelError if isinstance(error, httpx.ConnectTimeout) else _TryAgainError
            raise kind(f"{self._url} could not be asked ({type(error).__name__}: {error})") from error

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
        """The beginning of a server's answer, without the key that it may have repeated."""
        text = body.decode(errors="replace")
        text = text.replace(self._key, "***") if self._key else text
        return repr(text[:200])


def _data_url(picture: Picture) -> str:
    _, jpeg = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()


def endpoint_judge(endpoint: ChatEndpoint) -> PhaseJudge:
    """Phase labels from an endpoint, with the confidences that the model writes down."""

    def judge(question: PhaseQuestion) -> PhaseLabels:
        text = endpoint.complete(phase_prompt(question, AS_JSON))
        return read_phases(text, len(question.candidates))

    return PhaseJudge(f"openai {endpoint.model_id} v{WORDING}", judge)
