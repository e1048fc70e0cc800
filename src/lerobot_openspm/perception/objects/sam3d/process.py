"""A worker in another Python: started, asked and ended, never waited for beyond a deadline."""

from __future__ import annotations

import contextlib
import os
import selectors
import shlex
import signal
import subprocess
import tempfile
import time
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.objects.sam3d.worker import Message, WireError, pack, read_message

# Variables of our own environment that would lead another Python to our packages.
OURS = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV", "CONDA_PREFIX")
CLOSING_S = 2.0
STDERR_BYTES, STDERR_LINES = 8192, 15


@dataclass(frozen=True)
class _Running:
    """A worker's process, its pipes and the file its standard error goes to."""

    process: subprocess.Popen[bytes]
    stdin: IO[bytes]
    stdout: IO[bytes]
    stderr: IO[bytes]

    def last_words(self) -> str:
        """The last lines of its standard error."""
        # pread: a seek would move the worker's own place in the file.
        end = os.fstat(self.stderr.fileno()).st_size
        tail = os.pread(self.stderr.fileno(), STDERR_BYTES, max(0, end - STDERR_BYTES))
        return "\n".join(tail.decode(errors="replace").splitlines()[-STDERR_LINES:])


class WorkerProcess:
    """A worker that answers messages of `sam3d_worker.py`, started when it is first asked.

    Args:
        command: Program and arguments.
        start_timeout_s: Until it must be ready.
        timeout_s: Until it must have answered.
    """

    def __init__(self, command: Sequence[str], start_timeout_s: float, timeout_s: float):
        self.command = tuple(command)
        self.start_timeout_s, self.timeout_s = start_timeout_s, timeout_s
        self._running: _Running | None = None
        self._end = lambda: None
        self._id = 0

    def ask(self, message: Message) -> Message:
        """The worker's answer to a request's arrays and seed.

        Raises:
            PerceptionError: The worker cannot be started, died, hung or said something else than an
                answer, after which the next call starts another; or it says itself that it failed.
        """
        self._id += 1
        try:
            request = pack(Message("request", self._id, message.arrays, message.seed))
        except WireError as error:
            raise PerceptionError(f"{self._name}: cannot be sent {error}; pass a smaller picture") from error
        running = self._running or self._start()
        deadline = time.monotonic() + self.timeout_s
        try:
            _write(running.stdin, request, deadline)
            reply = _read(running.stdout, deadline)
            if reply.kind not in ("answer", "error") or reply.id != self._id:
                raise WireError(f"a message {reply.kind!r} {reply.id}, expected an answer {self._id}")
        except (OSError, EOFError, WireError, TimeoutError) as error:
            raise self._failed(error, running, f"answer within {self.timeout_s:g} s") from error
        except BaseException:
            # An interrupted exchange leaves half a message in the pipes.
            self.close()
            raise
        if reply.kind == "error":
            raise PerceptionError(
                f"{self._name}: got the error {reply.text!r}, expected an answer; "
                f"try {self._check!r}.{_quoted(running)}"
            )
        return reply

    def close(self) -> None:
        """End the worker, if it runs."""
        self._end()
        self._running, self._end = None, lambda: None

    def _start(self) -> _Running:
        environment = {name: value for name, value in os.environ.items() if name not in OURS}
        stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the worker
        try:
            process = subprocess.Popen(
                self.command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env=environment,
                bufsize=0,
                # A group of its own, so that what it starts can be ended with it.
                start_new_session=True,
            )
        except OSError as error:
            stderr.close()
            raise PerceptionError(
                f"{self._name}: cannot be started: {error}; expected the Python that SAM 3D Objects is "
                "installed in and the worker's script; see docs/sam3d.md"
            ) from error
        assert process.stdin is not None
        assert process.stdout is not None
        running = _Running(process, process.stdin, process.stdout, stderr)
        # Also when this object is forgotten, and when Python ends.
        self._end = weakref.finalize(self, _stop, running)
        self._running = running
        for pipe in (running.stdin, running.stdout):
            os.set_blocking(pipe.fileno(), False)
        try:
            ready = _read(running.stdout, time.monotonic() + self.start_timeout_s)
            if ready.kind != "ready":
                raise WireError(f"a message {ready.kind!r}, expected 'ready'")
        except (OSError, EOFError, WireError, TimeoutError) as error:
            raise self._failed(error, running, f"be ready within {self.start_timeout_s:g} s") from error
        except BaseException:
            self.close()
            raise
        return running

    @property
    def _name(self) -> str:
        return f"SAM 3D worker ({shlex.join(self.command)})"

    @property
    def _check(self) -> str:
        return shlex.join((*self.command, "--check"))

    def _failed(self, error: Exception, running: _Running, task: str) -> PerceptionError:
        """End the worker and say what it did instead of its task."""
        if isinstance(error, TimeoutError):
            got = "nothing"
        elif isinstance(error, WireError):
            got = str(error)
        else:
            code = _exit_code(running.process, CLOSING_S)
            got = "the end of its output" if code is None else f"its end with exit code {code}"
        # The process first: what it still prints while it dies belongs to its last words.
        _kill(running.process)
        words = _quoted(running)
        self.close()
        return PerceptionError(
            f"{self._name}: got {got}, expected it to {task}; try {self._check!r}, "
            f"or give it more time.{words}"
        )


def _quoted(running: _Running) -> str:
    words = running.last_words()
    return f" Its last lines:\n{words}" if words else " It printed nothing."


def _read(pipe: IO[bytes], deadline: float) -> Message:
    """One message. Raises EOFError at the end of the stream, TimeoutError, WireError or OSError."""

    def read(size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            _wait(pipe, selectors.EVENT_READ, deadline)
            part = os.read(pipe.fileno(), min(size - len(data), 1 << 20))
            if not part:
                break
            data += part
        return bytes(data)

    message = read_message(read)
    if message is None:
        raise EOFError
    return message


def _write(pipe: IO[bytes], data: bytes, deadline: float) -> None:
    """Raises BrokenPipeError where the worker has ended, or TimeoutError."""
    rest = memoryview(data)
    while rest:
        _wait(pipe, selectors.EVENT_WRITE, deadline)
        rest = rest[os.write(pipe.fileno(), rest) :]


def _wait(pipe: IO[bytes], event: int, deadline: float) -> None:
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, event)
        if not selector.select(max(0.0, deadline - time.monotonic())):
            raise TimeoutError


def _exit_code(process: subprocess.Popen[bytes], timeout_s: float) -> int | None:
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return None


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a worker and all it started, and take its exit code, so that it is no zombie."""
    # Where the whole group has ended, there is nothing to kill; macOS says so by a PermissionError.
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _stop(running: _Running) -> None:
    """Let a worker end by itself, as it does when its input ends; kill it where it does not."""
    running.stdin.close()
    running.stdout.close()
    if running.process.returncode is None:
        _exit_code(running.process, CLOSING_S)
        _kill(running.process)
    running.stderr.close()
