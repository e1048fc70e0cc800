"""A worker with made-up answers, honest or not: MODE, file of `sam3d_worker.py`, folder.

The folder holds `answer.npz`; the worker leaves its process's number and the last request there.
"""

import importlib.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

mode, worker_file, folder = sys.argv[1], sys.argv[2], Path(sys.argv[3])
spec = importlib.util.spec_from_file_location("sam3d_worker", worker_file)
wire = importlib.util.module_from_spec(spec)
sys.modules["sam3d_worker"] = wire
spec.loader.exec_module(wire)


def write(data):
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()


def prefix(header_bytes):
    return wire.PREFIX.pack(wire.MAGIC, header_bytes)


def with_header(message, **changes):
    """A message's bytes with some fields of its header changed, its body as it is."""
    data = wire.pack(message)
    length = wire.PREFIX.unpack(data[: wire.PREFIX.size])[1]
    header = json.loads(data[wire.PREFIX.size :][:length]) | changes
    text = json.dumps(header).encode()
    return prefix(len(text)) + text + data[wire.PREFIX.size + length :]


def answers():
    with np.load(folder / "answer.npz") as stored:
        return dict(stored)


def misbehave(request):
    answer = wire.Message("answer", request.id, answers())
    if mode == "dies":
        print("CUDA out of memory", file=sys.stderr, flush=True)
        os._exit(7)
    elif mode == "hangs":
        time.sleep(60)
    elif mode == "hangs with a child":
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        (folder / "child").write_text(str(child.pid))
        time.sleep(60)
    elif mode == "closes its output":
        os.close(1)
        time.sleep(60)
    elif mode == "says garbage":
        write(b"Loading weights: 100%|#####|\n" * 4)
        time.sleep(60)
    elif mode == "another version":
        write(with_header(answer, version=2))
        time.sleep(60)
    elif mode == "huge header":
        write(prefix(1 << 31))
        time.sleep(60)
    elif mode == "huge body":
        write(
            with_header(
                answer, arrays=[{"name": "points", "dtype": "float64", "shape": [1 << 30, 1 << 30, 3]}]
            )
        )
        time.sleep(60)
    elif mode == "breaks off":
        write(wire.pack(answer)[:-9])
        os._exit(0)
    elif mode == "old answer":
        write(wire.pack(wire.Message("answer", request.id - 1, answers())))
        time.sleep(60)
    elif mode == "asks back":
        write(wire.pack(wire.Message("request", request.id, {})))
        time.sleep(60)
    else:
        raise SystemExit(f"no mode {mode!r}")


def honest(request):
    np.savez(folder / "request.npz", seed=request.seed, **request.arrays)
    if mode == "raises":
        raise RuntimeError("no object here")
    return answers()


def main():
    (folder / "pid").write_text(str(os.getpid()))
    started_before = (folder / "started").exists()
    (folder / "started").touch()
    if mode == "dies at start":
        print("ModuleNotFoundError: No module named 'sam3d_objects'", file=sys.stderr, flush=True)
        sys.exit(3)
    if mode == "is never ready":
        time.sleep(60)
    if mode == "greets":
        write(b"Welcome to SAM 3D!\n")
        time.sleep(60)
    if mode == "does not read":
        write(wire.pack(wire.Message("ready", 0, {})))
        time.sleep(60)
    if mode in ("honest", "raises", "stays") or (mode == "dies once" and started_before):
        wire.serve(sys.stdin.buffer.read, write, honest)
        if mode == "stays":
            time.sleep(60)
        return
    if mode == "dies once":
        sys.exit(1)
    write(wire.pack(wire.Message("ready", 0, {})))
    misbehave(wire.read_message(sys.stdin.buffer.read))


main()
