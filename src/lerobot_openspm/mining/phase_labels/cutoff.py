"""Ending a request at a deadline, whatever it is doing then."""

from __future__ import annotations

import socket
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any


class Cutoff:
    """Shuts the connections of a request when its time is over; a context manager.

    The timeouts of httpx count anew with every piece that arrives, so a server that sends a byte now and then
    would be waited for without end.

    Args:
        left_s: Time until then, in seconds.
    """

    def __init__(self, left_s: float) -> None:
        self._timer = threading.Timer(left_s, self._cut)
        self._timer.daemon = True
        self._lock = threading.Lock()
        self._sockets: list[socket.socket] = []
        self.passed = False

    def __enter__(self) -> Cutoff:
        self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        with self._lock:
            for one in self._sockets:
                one.close()
            self._sockets.clear()

    def trace(self, event: str, info: Mapping[str, Any]) -> None:
        """Take note of a connection: httpx's extension "trace"."""
        if event == "connection.connect_tcp.complete":
            # A duplicate, because TLS takes the socket itself away. Shutting either shuts the connection.
            own = info["return_value"].get_extra_info("socket").dup()
            with self._lock:
                self._sockets.append(own)
                if self.passed:
                    _shut(own)

    def _cut(self) -> None:
        with self._lock:
            self.passed = True
            for one in self._sockets:
                _shut(one)


def _shut(one: socket.socket) -> None:
    with suppress(OSError):  # it is shut already
        one.shutdown(socket.SHUT_RDWR)
