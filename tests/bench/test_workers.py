"""Jobs give the same results in this process and in others."""

import os

import pytest

from lerobot_openspm.bench.workers import each


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_is_done_once(workers: int):
    jobs = [(f"name_{i}",) for i in range(3)]
    assert sorted(each(workers, os.path.abspath, jobs)) == [os.path.abspath(name) for (name,) in jobs]
    assert list(each(workers, os.path.abspath, [])) == []


def test_a_single_worker_stays_in_this_process():
    assert list(each(1, os.getpid, [(), ()])) == [os.getpid()] * 2
    assert os.getpid() not in each(2, os.getpid, [(), ()])
