"""Jobs in processes of their own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed


def each[T](
    workers: int, function: Callable[..., T], jobs: Sequence[tuple[object, ...]], what: str = "Episodes"
) -> Iterable[T]:
    """Call a function for every job in processes of their own; yields results as they come.

    Args:
        workers: How many at a time.
        function: What to call; a function of a module.
        jobs: Its arguments.
        what: Name of the progress bar.
    """
    from tqdm import tqdm

    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) as pool:
        running = [pool.submit(function, *job) for job in jobs]
        try:
            for future in tqdm(as_completed(running), what, len(running), disable=not jobs):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)
