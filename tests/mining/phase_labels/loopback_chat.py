"""An OpenAI-compatible chat server on 127.0.0.1 that behaves, or misbehaves, as a test wants it to."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Request = dict[str, Any]


@dataclass(frozen=True)
class Reply:
    """What goes over the wire.

    Attributes:
        body: Sent as it is.
        status: HTTP's.
        wait_s: Before anything is sent.
        drip_s: Between any two bytes of the body.
        head_drip_s: Between any two bytes of the headers.
        has_length: Whether the length is told; else the body ends where the connection does.
        location: Where a redirect leads.
        promised: Content-Length, where it is not the body's: the connection is closed too early then.
    """

    body: bytes
    status: int = 200
    wait_s: float = 0.0
    drip_s: float = 0.0
    promised: int | None = None
    head_drip_s: float = 0.0
    has_length: bool = True
    location: str = ""


def completion(content: Any) -> bytes:
    """A chat completion with this content."""
    message = {"role": "assistant", "content": content}
    return json.dumps({"object": "chat.completion", "choices": [{"index": 0, "message": message}]}).encode()


def question_of(request: Request) -> dict[str, Any]:
    """The JSON line in a request's text: a trajectory, or a scene."""
    text = request["messages"][0]["content"][-1]["text"]
    return next(json.loads(line) for line in text.splitlines() if line.startswith("{"))


def say(phases: list[str], confidence: float = 0.9) -> bytes:
    """A well-formed answer with these phases."""
    items = [{"candidate": i, "phase": p, "confidence": confidence} for i, p in enumerate(phases, start=1)]
    return completion(json.dumps({"phases": items}))


@dataclass
class LoopbackChat:
    """The server. `requests` holds what was asked, `headers` the headers it came with."""

    answer: Callable[[Request], Reply]
    requests: list[Request] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    api_base: str = ""

    @contextmanager
    def running(self) -> Iterator["LoopbackChat"]:
        """Serve while the context lasts."""
        handler = type("Handler", (_Handler,), {"chat": self})
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        self.api_base = f"http://127.0.0.1:{server.server_address[1]}/v1"
        try:
            yield self
        finally:
            server.shutdown()
            server.server_close()
            thread.join()


class _Handler(BaseHTTPRequestHandler):
    chat: LoopbackChat

    def do_POST(self) -> None:
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.chat.requests.append(request)
        self.chat.headers.append(dict(self.headers))
        reply = self.chat.answer(request) if self.path == "/v1/chat/completions" else Reply(b"", 404)
        time.sleep(reply.wait_s)
        try:
            self.send_response(reply.status)
            if reply.has_length:
                self.send_header("Content-Length", str(reply.promised or len(reply.body)))
            if reply.location:
                self.send_header("Location", reply.location)
            self._send(b"".join([*self._headers_buffer, b"\r\n"]), reply.head_drip_s)
            self._send(reply.body, reply.drip_s)
        except ConnectionError:  # the client has had enough
            pass
        self.close_connection = True

    def _send(self, blob: bytes, drip_s: float) -> None:
        for piece in [blob[i : i + 1] for i in range(len(blob))] if drip_s else [blob]:
            self.wfile.write(piece)
            time.sleep(drip_s)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""
