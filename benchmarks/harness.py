"""Runs a benchmark's jobs, several at a time, and keeps what each gave: an interrupted run goes on."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lerobot_openspm.cli.pipeline import digest, discard_unless
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.workplaces import folders

# What is kept of an episode or another job.
type Row = dict[str, Any]
HERE = Path(__file__).parent
# What every benchmark that runs episodes shares, beside its own module.
SHARED = ("episodes.py", "worlds.py")


def measured_folder(folder: Path, files: Sequence[Path], options: Sequence[str], module: str) -> Path:
    """A folder for what is measured; what it holds of other code, files or options is removed.

    Args:
        folder: Where.
        files: What is measured beside the package's code, such as a checkpoint's files.
        options: With which settings.
        module: ``__file__`` of the benchmark.

    Raises:
        OpenSPMError: It holds something that was not measured here.
    """
    ours = folder.with_name(f"{folder.name}.sha256")
    if folder.is_dir() and any(folder.iterdir()) and not ours.is_file():
        raise OpenSPMError(f"{folder} holds something that was not measured here; choose another --output")
    code = [Path(module), *(HERE / name for name in SHARED)]
    discard_unless(folder, digest([*code, *files], options))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def checkpoint_files(checkpoint: Path) -> list[Path]:
    """What a checkpoint acts by."""
    memories = [folder / "memory.json" for folder in folders(checkpoint)]
    names = ("model.safetensors", "cameras.json", "config.json")
    return [path for path in (*memories, *(checkpoint / name for name in names)) if path.is_file()]


def resume(
    log: Path, jobs: Mapping[str, tuple[Any, ...]], run: Callable[..., Row], workers: int
) -> list[Row]:
    """What each job gave, in their order; those that the log does not hold are run, and noted as they end.

    Args:
        log: A line of JSON for each job.
        jobs: The arguments of each by its name.
        run: A function of a module.
        workers: How many run at a time, see :func:`each`.
    """
    done = read(log)
    left = [(run, name, arguments) for name, arguments in jobs.items() if name not in done]
    with log.open("a") as file:
        # A job that was being written when a run was killed is run again.
        file.write("\n" * (log.stat().st_size > 0 and not log.read_bytes().endswith(b"\n")))
        for name, row in each(workers, _named, left):
            file.write(json.dumps({"job": name, **row}) + "\n")
            file.flush()
            done[name] = row
    return [done[name] for name in jobs]


def read(log: Path) -> dict[str, Row]:
    """The jobs that were noted by name; a torn line is left out."""
    found = {}
    for line in log.read_text().splitlines() if log.exists() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        found[row.pop("job")] = row
    return found


def _named(run: Callable[..., Row], name: str, arguments: tuple[Any, ...]) -> tuple[str, Row]:
    return name, run(*arguments)


def each[T](workers: int, function: Callable[..., T], jobs: Sequence[tuple[Any, ...]]) -> Iterator[T]:
    """Call a function of a module with the arguments of every job; yields results as they come.

    Each of several workers is a process of its own. A single one stays in this process, since a new one would
    first import all of LeRobot.
    """
    if workers == 1:
        yield from tqdm((function(*job) for job in jobs), "Jobs", len(jobs), disable=not jobs)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        running = [pool.submit(function, *job) for job in jobs]
        try:
            for future in tqdm(as_completed(running), "Jobs", len(running), disable=not jobs):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)
