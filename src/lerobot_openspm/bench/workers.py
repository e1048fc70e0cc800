"""Jobs, several at a time in processes of their own or one after the other in this one."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed


def each[T](
    workers: int, function: Callable[..., T], jobs: Sequence[tuple[object, ...]], what: str = "Episodes"
) -> Iterable[T]:
    """Call a function for every job; yields results as they come.

    Args:
        workers: How many at a time, each in a process of its own. A single one stays in this process, since a
            new one would first import all of LeRobot.
        function: What to call; a function of a module.
        jobs: Its arguments.
        what: Name of the progress bar.
    """
    from tqdm import tqdm

    if workers == 1:
        yield from tqdm((function(*job) for job in jobs), what, len(jobs), disable=not jobs)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) as pool:
        running = [pool.submit(function, *job) for job in jobs]
        try:
            for future in tqdm(as_completed(running), what, len(running), disable=not jobs):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)
