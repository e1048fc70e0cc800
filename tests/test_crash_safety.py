"""Whatever interrupts a save, the memory before or the new one is there, whole."""

import errno
import os
import random
import select
import signal
import time
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest
from tests.memory.builders import entry
from tests.memory.memories import a_memory, same
from tests.memory.memory_files import names

from lerobot_openspm import files
from lerobot_openspm.errors import MemoryFormatError, OpenSPMError
from lerobot_openspm.memory.io import LOCK, changing, read_memory, write_memory

OLD = a_memory()
NEWER_CAMERAS = {key: replace(camera, fx=77.5) for key, camera in OLD.cameras.items()}
NEWER = replace(OLD, entries=(entry(quality=0.1, source="new#1"),), cameras=NEWER_CAMERAS)
THIRD = replace(OLD, entries=OLD.entries[:1])
SOURCES = [e.source for e in OLD.entries]
# What a save asks the system for.
CALLS = {"os": ("replace", "fsync", "open"), "pathlib.Path": ("open", "unlink", "mkdir")}


def no_space_left():
    raise OSError(errno.ENOSPC, "no space left")


def kill_9():
    os.kill(os.getpid(), signal.SIGKILL)


class Fault:
    """Does something at the n-th system call of a save, or counts the calls."""

    def __init__(self, monkeypatch, at=None, what=no_space_left):
        self.count, self._at, self._what = 0, at, what
        for owner, functions in ((os, CALLS["os"]), (Path, CALLS["pathlib.Path"])):
            for name in functions:
                monkeypatch.setattr(owner, name, self._failing(getattr(owner, name)))

    def _failing(self, function):
        def call(*args, **kwargs):
            self.count += 1
            if self.count == self._at:
                self._what()
            return function(*args, **kwargs)

        return call


def visible(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != LOCK)


def n_calls(tmp_path):
    write_memory(OLD, tmp_path / "counted")
    with pytest.MonkeyPatch.context() as patched:
        fault = Fault(patched)
        write_memory(NEWER, tmp_path / "counted")
    return fault.count


def test_a_save_that_fails_at_any_call_leaves_the_old_memory_or_the_new_one(tmp_path):
    outcomes = []
    for at in range(1, n_calls(tmp_path) + 1):
        folder = tmp_path / str(at)
        write_memory(OLD, folder)
        with pytest.MonkeyPatch.context() as patched:
            Fault(patched, at)
            try:
                write_memory(NEWER, folder)
            except OSError as error:
                outcomes.append(error.errno)
        loaded = read_memory(folder)
        assert same(loaded, OLD) or same(loaded, NEWER)
        outcomes.append("old" if same(loaded, OLD) else "new")
        # The next save is not disturbed by what is left, and leaves nothing of it.
        write_memory(NEWER, folder)
        assert same(read_memory(folder), NEWER)
        assert visible(folder) == sorted(names(folder))
    assert {"old", "new", errno.ENOSPC} <= set(outcomes)
    assert len(outcomes) > 20


def test_a_first_save_that_fails_is_no_memory(tmp_path):
    with pytest.MonkeyPatch.context() as patched:
        Fault(patched, 6)
        with pytest.raises(OSError, match="no space"):
            write_memory(OLD, tmp_path)
    with pytest.raises(MemoryFormatError, match=r"no memory at .*memory\.json"):
        read_memory(tmp_path)


def in_another_process(function):
    """Run a function in a fork of this process, which ends with it; returns its process id."""
    pid = os.fork()
    if pid == 0:
        try:
            function()
        finally:
            os._exit(0)
    return pid


def test_the_memory_survives_kill_9_at_any_call(tmp_path):
    seen = set()
    for at in range(1, n_calls(tmp_path) + 1):
        folder = tmp_path / str(at)
        write_memory(OLD, folder)

        def save_and_die(at=at, folder=folder):
            Fault(pytest.MonkeyPatch(), at, kill_9)
            write_memory(NEWER, folder)

        _, status = os.waitpid(in_another_process(save_and_die), 0)
        assert os.WTERMSIG(status) == signal.SIGKILL
        loaded = read_memory(folder)
        is_old = same(loaded, OLD)
        assert is_old or same(loaded, NEWER)
        seen.add((is_old, len(visible(folder))))
        write_memory(THIRD, folder)
        assert visible(folder) == sorted(names(folder))
    # It was cut off before and after the one moment that counts, and some files were left over.
    assert {is_old for is_old, _ in seen} == {True, False}
    assert len({n_files for _, n_files in seen}) > 1


@pytest.mark.slow
def test_the_memory_survives_kill_9_at_any_moment(tmp_path):
    """Also in the middle of a call, which is a matter of chance."""
    rng = random.Random(0)
    write_memory(OLD, tmp_path)

    read, write = os.pipe()

    def save_for_ever():
        # Nothing that the system holds is lost with a process, so nobody needs to wait for the disk.
        os.fsync = lambda fd: None
        while True:
            for one in (NEWER, OLD):
                write_memory(one, tmp_path)
                os.write(write, b".")

    for _ in range(100):
        start_s = time.perf_counter()
        pid = in_another_process(save_for_ever)
        # However busy the machine is, it falls into the next two saves: they take as long as the first one.
        assert os.read(read, 1) == b"."
        time.sleep(rng.uniform(0, 2 * (time.perf_counter() - start_s)))
        os.kill(pid, signal.SIGKILL)
        while select.select([read], [], [], 0)[0]:
            os.read(read, 100)
        os.waitpid(pid, 0)
        loaded = read_memory(tmp_path)
        assert same(loaded, OLD) or same(loaded, NEWER)
    write_memory(NEWER, tmp_path)
    assert visible(tmp_path) == sorted(names(tmp_path))


def test_two_processes_that_add_at_once_lose_nothing_of_each_other(tmp_path):
    write_memory(OLD, tmp_path)

    def add(name):
        for i in range(10):
            with changing(tmp_path):
                memory = read_memory(tmp_path)
                added = replace(memory, entries=(entry(source=f"{name}#{i}"),))
                write_memory(memory.appended(added), tmp_path)

    for pid in [in_another_process(lambda name=name: add(name)) for name in ("one", "two")]:
        os.waitpid(pid, 0)
    found = [e.source for e in read_memory(tmp_path).entries]
    assert sorted(found) == sorted([f"{n}#{i}" for n in ("one", "two") for i in range(10)] + SOURCES)


def test_a_memory_can_be_read_while_another_process_saves(tmp_path):
    write_memory(OLD, tmp_path)

    def numbered(i):
        cameras = {key: replace(camera, fx=50.1 + i) for key, camera in OLD.cameras.items()}
        return replace(OLD, entries=(*OLD.entries, entry(version=1 + i)), cameras=cameras)

    def save_for_ever():
        for i in count(1):
            write_memory(numbered(i), tmp_path)

    write_memory(numbered(0), tmp_path)
    pid = in_another_process(save_for_ever)
    seen = set()
    # As many reads as it takes: on a busy machine, the other process may not run between two of them.
    while len(seen) < 10:
        assert os.waitpid(pid, os.WNOHANG) == (0, 0), "the other process came to an end"
        loaded = read_memory(tmp_path)
        seen.add(loaded.entries[-1].version)
        assert same(loaded, numbered(loaded.entries[-1].version - 1))
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def test_a_memory_whose_arrays_are_removed_while_it_is_read_is_read_anew(tmp_path, monkeypatch):
    write_memory(OLD, tmp_path)
    stat = Path.stat

    def save_a_newer_one(path, **options):
        found = stat(path, **options)
        if path.name.endswith(".safetensors"):
            monkeypatch.undo()
            write_memory(NEWER, tmp_path)
        return found

    monkeypatch.setattr(Path, "stat", save_a_newer_one)
    assert same(read_memory(tmp_path), NEWER)


def test_who_waits_too_long_for_another_process_is_told(tmp_path, monkeypatch):
    write_memory(OLD, tmp_path)
    read, write = os.pipe()

    def hold():
        with changing(tmp_path):
            os.write(write, b"held")
            time.sleep(30)

    pid = in_another_process(hold)
    assert os.read(read, 4) == b"held"
    monkeypatch.setattr(files, "LOCK_WAIT_S", 0.1)
    with pytest.raises(OpenSPMError, match="another process has been changing this"):
        write_memory(NEWER, tmp_path)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    # Whoever holds it and is killed holds it no more.
    write_memory(NEWER, tmp_path)
    assert same(read_memory(tmp_path), NEWER)
