"""Watches how much memory processes take that something else starts and waits for."""

from __future__ import annotations

import contextlib
import os
import re
import threading
from collections.abc import Generator, Iterator
from pathlib import Path

PROC, EVERY_S = Path("/proc"), 0.2
PEAK = re.compile(r"^VmHWM:\s*(\d+) kB", re.M)


@contextlib.contextmanager
def watched_memory() -> Generator[dict[int, int]]:
    """By process, the most memory (RSS, bytes) that it has had, of all started below this one meanwhile.

    Empty where the system does not tell it. What `resource.getrusage` tells of children is no less than this
    process had itself when it started them.
    """
    peaks, is_over, before = dict[int, int](), threading.Event(), set(_below(os.getpid()))

    def watch() -> None:
        while not is_over.wait(EVERY_S):
            # The last word counts: before a process runs its own program it tells this one's.
            started = set(_below(os.getpid())) - before
            peaks.update({pid: peak for pid in started if (peak := _peak(pid)) is not None})

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield peaks
    finally:
        is_over.set()
        thread.join()


def _below(pid: int) -> Iterator[int]:
    """The processes that a process has started, and those that these have."""
    for file in PROC.glob(f"{pid}/task/*/children"):
        for child in map(int, _read(file).split()):
            yield child
            yield from _below(child)


def _peak(pid: int) -> int | None:
    found = PEAK.search(_read(PROC / str(pid) / "status"))
    return None if found is None else 1024 * int(found[1])


def _read(file: Path) -> str:
    """What a file of the system says; nothing once its process has ended."""
    try:
        return file.read_text()
    except OSError:
        return ""
