"""How much memory other processes took is told of them, not of the one that started them."""

import subprocess
import sys

from benchmarks.processes import watched_memory

MB = 1_000_000
HOLD = "import sys, time; held = bytearray(b'x') * int(sys.argv[1]); del held; time.sleep(1)"


def test_the_most_that_processes_below_this_one_had_is_told_of_each():
    # More than the others: a child begins with it.
    own = bytearray(b"x") * (400 * MB)
    deeper = (
        f"import subprocess, sys; subprocess.run([sys.executable, '-c', {HOLD!r}, '{200 * MB}'], check=True)"
    )
    with watched_memory() as peaks:
        subprocess.run([sys.executable, "-c", deeper], check=True)
    first, second = sorted(peaks.values())
    assert first < 100 * MB
    assert 200 * MB < second < 300 * MB < len(own)


def test_processes_that_ended_before_are_not_told():
    subprocess.run([sys.executable, "-c", HOLD, str(100 * MB)], check=True)
    with watched_memory() as peaks:
        pass
    assert peaks == {}


def test_processes_that_were_there_before_are_not_told():
    held = [sys.executable, "-c", "input()"]
    with subprocess.Popen(held, stdin=subprocess.PIPE) as other:
        with watched_memory() as peaks:
            subprocess.run([sys.executable, "-c", HOLD, str(MB)], check=True)
        other.communicate(b"\n")
    assert len(peaks) == 1
    assert other.pid not in peaks
