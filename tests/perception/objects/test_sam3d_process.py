"""What a worker can do wrong, each by a process that does it."""

import gc
import os
import sys
import time

import numpy as np
import pytest
from tests.perception.objects import sam3d_scene as scene
from tests.perception.objects.test_sam3d import client, told

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.objects.sam3d import process as sam3d_process
from lerobot_openspm.perception.objects.sam3d.size import Sam3dShape
from lerobot_openspm.types import Segmentation, View

pytestmark = pytest.mark.skipif(os.name != "posix", reason="SAM 3D Objects runs on Linux only")


@pytest.fixture(autouse=True)
def short_farewell(monkeypatch):
    monkeypatch.setattr(sam3d_process, "CLOSING_S", 0.3)


@pytest.fixture
def seen():
    return scene.seen()


def pid(folder, name="pid"):
    return int((folder / name).read_text())


def runs(process):
    """Whether there is such a process, be it a zombie."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def gone(process, within_s=2.0):
    """Whether it is gone; an orphan is taken away by whoever adopts it, which takes a moment."""
    end = time.monotonic() + within_s
    while runs(process) and time.monotonic() < end:
        if is_dead_orphan(process):
            return True
        time.sleep(0.01)
    return not runs(process)


def is_dead_orphan(process):
    try:
        with open(f"/proc/{process}/stat") as stat:
            fields = stat.read().rsplit(")", 1)[1].split()
    except FileNotFoundError:
        return False
    return fields[0] == "Z" and int(fields[1]) != os.getpid()


MISBEHAVIOURS = {
    "dies at start": ["exit code 3", "No module named 'sam3d_objects'", "be ready within"],
    "is never ready": ["got nothing", "be ready within 1.5 s", "printed nothing"],
    "greets": ["b'Welcome to S", "begins with"],
    "dies": ["exit code 7", "CUDA out of memory", "answer within"],
    "hangs": ["got nothing", "answer within 1 s"],
    "hangs with a child": ["got nothing", "answer within 1 s"],
    "closes its output": ["got the end of its output"],
    "says garbage": ["b'Loading weig", "begins with"],
    "another version": ["version 2", "expected 1"],
    "huge header": ["a header of 2147483648 bytes", "expected at most 65536"],
    "huge body": ["arrays of 27670116110564327424 bytes", "expected at most 268435456"],
    "breaks off": ["a message that breaks off"],
    "old answer": ["'answer' 0", "expected an answer 1"],
    "asks back": ["'request' 1", "expected an answer 1"],
}


@pytest.mark.parametrize(("mode", "parts"), MISBEHAVIOURS.items(), ids=MISBEHAVIOURS)
def test_a_worker_that_misbehaves_is_one_error_and_no_process(tmp_path, seen, mode, parts):
    told(tmp_path, **scene.described(seen[0].T_world_cam))
    start = 1.5 if mode == "is never ready" else 30.0
    begun = time.monotonic()
    with client(tmp_path, mode, start_timeout_s=start, timeout_s=1.0) as shapes:
        with pytest.raises(PerceptionError) as caught:
            shapes.describe(*seen)
        assert not runs(pid(tmp_path))
        if mode == "hangs with a child":
            assert gone(pid(tmp_path, "child"))
    assert time.monotonic() - begun < 10
    message = str(caught.value)
    for part in (*parts, "fake_sam3d_worker.py", "--check"):
        assert part in message


def test_a_worker_that_does_not_read_is_not_waited_for(tmp_path, seen):
    # More than a pipe holds.
    large = View(np.zeros((900, 900, 3), np.uint8), seen[0].camera, seen[0].T_world_cam)
    mask = Segmentation(np.ones((900, 900), bool), 1.0)
    with client(tmp_path, "does not read", support_height=0.0, timeout_s=0.5) as shapes:
        with pytest.raises(PerceptionError, match="got nothing"):
            shapes.describe(large, mask)
        assert not runs(pid(tmp_path))


def test_a_picture_that_is_too_large_is_not_sent(tmp_path, seen):
    large = View(np.zeros((10000, 10000, 3), np.uint8), seen[0].camera, seen[0].T_world_cam)
    mask = Segmentation(np.ones((10000, 10000), bool), 1.0)
    with (
        client(tmp_path, support_height=0.0) as shapes,
        pytest.raises(PerceptionError, match="400000000 bytes"),
    ):
        shapes.describe(large, mask)
    assert not (tmp_path / "started").exists()


@pytest.mark.parametrize("program", ["no/such/python", os.devnull])
def test_a_python_that_is_none(seen, program):
    with pytest.raises(PerceptionError, match=r"cannot be started.*docs/sam3d\.md"):
        Sam3dShape((program, "worker.py")).describe(*seen)


def test_an_error_in_one_answer_leaves_the_worker_running(tmp_path, seen):
    with client(tmp_path, "raises") as shapes:
        for _ in range(2):
            with pytest.raises(PerceptionError, match="RuntimeError: no object here") as caught:
                shapes.describe(*seen)
            assert "Traceback" in str(caught.value)
            first = pid(tmp_path)
            assert runs(first)
        assert pid(tmp_path) == first
    assert not runs(first)


def test_an_answer_without_sense_leaves_the_worker_running(tmp_path, seen):
    answer = scene.described(seen[0].T_world_cam)
    told(tmp_path, **answer | {"translation": np.full(3, np.nan)})
    with client(tmp_path) as shapes:
        with pytest.raises(PerceptionError, match="finite"):
            shapes.describe(*seen)
        told(tmp_path, **answer)
        first = pid(tmp_path)
        assert shapes.describe(*seen).quality > 0.9
        assert pid(tmp_path) == first


def test_after_a_death_the_next_call_starts_another(tmp_path, seen):
    told(tmp_path, **scene.described(seen[0].T_world_cam))
    with client(tmp_path, "dies once") as shapes:
        with pytest.raises(PerceptionError, match="exit code 1"):
            shapes.describe(*seen)
        assert shapes.describe(*seen).quality > 0.9


def test_a_worker_killed_between_two_calls(tmp_path, seen):
    told(tmp_path, **scene.described(seen[0].T_world_cam))
    with client(tmp_path) as shapes:
        shapes.describe(*seen)
        os.kill(pid(tmp_path), 9)
        with pytest.raises(PerceptionError, match="exit code -9"):
            shapes.describe(*seen)
        assert shapes.describe(*seen).quality > 0.9


@pytest.mark.parametrize("mode", ["honest", "stays"])
def test_closing_ends_the_worker_even_if_it_stays(tmp_path, seen, mode):
    told(tmp_path, **scene.described(seen[0].T_world_cam))
    shapes = client(tmp_path, mode)
    shapes.close()
    shapes.describe(*seen)
    assert runs(pid(tmp_path))
    shapes.close()
    assert not runs(pid(tmp_path))
    shapes.close()


def test_a_forgotten_client_ends_its_worker(tmp_path, seen):
    told(tmp_path, **scene.described(seen[0].T_world_cam))
    shapes = client(tmp_path)
    shapes.describe(*seen)
    del shapes
    gc.collect()
    assert not runs(pid(tmp_path))


def test_an_interruption_ends_the_worker(tmp_path, seen, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    told(tmp_path, **scene.described(seen[0].T_world_cam))
    with client(tmp_path) as shapes:
        shapes.describe(*seen)
        monkeypatch.setattr(sam3d_process, "_read", interrupted)
        with pytest.raises(KeyboardInterrupt):
            shapes.describe(*seen)
        assert not runs(pid(tmp_path))


def test_our_own_packages_are_not_the_workers(tmp_path, seen, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    monkeypatch.setenv("CONDA_PREFIX", "elsewhere")
    report = "import os, sys; sys.exit(str([os.environ.get(k) for k in ('PYTHONPATH', 'CONDA_PREFIX')]))"
    with pytest.raises(PerceptionError, match=r"\[None, None\]"):
        Sam3dShape((sys.executable, "-c", report)).describe(*seen)
