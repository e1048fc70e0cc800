"""What a worker can do wrong, each by a process that does it."""

import os
import subprocess
import sys
import time

import pytest
from tests.perception.objects import sam3d_scene as scene
from tests.perception.objects.test_sam3d import backend, told

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.objects.base import Appearance
from lerobot_openspm.perception.objects.sam3d.size import Sam3dShape

pytestmark = pytest.mark.skipif(os.name != "posix", reason="SAM 3D Objects runs on Linux only")


@pytest.fixture
def seen():
    return Appearance(*scene.seen())


def pid(folder, name="pid"):
    return int((folder / name).read_text())


def runs(process):
    """Whether there is such a process that is not a zombie."""
    try:
        with open(f"/proc/{process}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


MISBEHAVIOURS = {
    "dies": ["exit code 7", "CUDA out of memory"],
    "hangs": ["nothing after 1.5 s", "printed nothing"],
    "hangs with a child": ["nothing after 1.5 s"],
    "writes nothing": ["no answers that can be read", "answers.npz"],
    "writes garbage": ["no answers that can be read"],
    "breaks off": ["no answers that can be read"],
    "pickles": ["no answers that can be read", "allow_pickle=False"],
    "raises": ["the error 'RuntimeError: no object here'"],
}


@pytest.mark.parametrize(("mode", "parts"), MISBEHAVIOURS.items(), ids=MISBEHAVIOURS)
def test_a_worker_that_misbehaves_is_one_error_and_no_process(tmp_path, seen, mode, parts):
    told(tmp_path, **scene.described(seen.view.T_world_cam))
    waits = "hangs" in mode
    shapes = backend(tmp_path, mode, start_timeout_s=1.0 if waits else 60.0, timeout_s=0.5)
    begun = time.monotonic()
    with pytest.raises(PerceptionError) as caught:
        shapes.describe([seen])
    assert time.monotonic() - begun < 20
    assert not runs(pid(tmp_path))
    if mode == "hangs with a child":
        # It is killed, but nobody waits for it: on a busy machine it may take a moment to end.
        while runs(pid(tmp_path, "child")) and time.monotonic() - begun < 20:
            time.sleep(0.05)
        assert not runs(pid(tmp_path, "child"))
    for part in (*parts, "fake_sam3d_worker.py", "--check"):
        assert part in str(caught.value)


@pytest.mark.parametrize("program", ["no/such/python", os.devnull])
def test_a_python_that_is_none(seen, program):
    with pytest.raises(PerceptionError, match=r"cannot be started.*docs/sam3d\.md"):
        Sam3dShape((program, "worker.py")).describe([seen])


def test_an_interruption_ends_the_worker(tmp_path, seen, monkeypatch):
    wait, interrupted = subprocess.Popen.wait, []

    def interrupt(process, timeout=None):
        if not interrupted:
            interrupted.append(process.pid)
            raise KeyboardInterrupt
        return wait(process, timeout)

    monkeypatch.setattr(subprocess.Popen, "wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        backend(tmp_path, "hangs").describe([seen])
    assert not runs(interrupted[0])


def test_our_own_packages_are_not_the_workers(tmp_path, seen, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    monkeypatch.setenv("CONDA_PREFIX", "elsewhere")
    report = "import os, sys; sys.exit(str([os.environ.get(k) for k in ('PYTHONPATH', 'CONDA_PREFIX')]))"
    with pytest.raises(PerceptionError, match=r"\[None, None\]"):
        Sam3dShape((sys.executable, "-c", report)).describe([seen])
