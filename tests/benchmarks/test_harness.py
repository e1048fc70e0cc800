"""Jobs give the same results in this process and in others, and what was measured is kept."""

import os
from pathlib import Path

import pytest
from benchmarks.harness import each, measured_folder, resume

from lerobot_openspm.errors import OpenSPMError


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_is_done_once(workers: int):
    jobs = [(f"name_{i}",) for i in range(3)]
    assert sorted(each(workers, os.path.abspath, jobs)) == [os.path.abspath(name) for (name,) in jobs]
    assert list(each(workers, os.path.abspath, [])) == []


def test_a_single_worker_stays_in_this_process():
    assert list(each(1, os.getpid, [(), ()])) == [os.getpid()] * 2
    assert os.getpid() not in each(2, os.getpid, [(), ()])


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path):
    log, ran = tmp_path / "log.jsonl", []

    def run(number: int) -> dict[str, int]:
        ran.append(number)
        return {"squared": number**2}

    jobs = {f"job {i}": (i,) for i in range(3)}
    whole = resume(log, jobs, run, 1)
    assert [row["squared"] for row in whole] == [0, 1, 4]
    lines = log.read_text().splitlines(keepends=True)
    # The last job was being written when the run was killed.
    log.write_text("".join(lines[:2]) + lines[2][:9])
    del ran[:]
    assert resume(log, jobs, run, 1) == whole
    assert ran == [2]
    assert resume(log, jobs, run, 1) == whole
    assert ran == [2]


def test_a_folder_is_kept_for_what_it_was_made_of(tmp_path: Path):
    policy, folder = tmp_path / "policy", tmp_path / "out"
    policy.write_text("one")
    (measured_folder(folder, [policy], ["fast"], __file__) / "log").write_text("")
    assert (measured_folder(folder, [policy], ["fast"], __file__) / "log").is_file()
    assert not (measured_folder(folder, [policy], ["slow"], __file__) / "log").exists()
    (folder / "log").write_text("")
    policy.write_text("two")
    assert not (measured_folder(folder, [policy], ["slow"], __file__) / "log").exists()


def test_a_folder_of_somebody_else_is_left_alone(tmp_path: Path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("do not remove")
    with pytest.raises(OpenSPMError, match="holds something that was not measured here"):
        measured_folder(tmp_path / "mine", [], [], __file__)
    assert (tmp_path / "mine" / "precious.txt").read_text() == "do not remove"
