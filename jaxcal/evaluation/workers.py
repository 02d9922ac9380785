"""Worker processes of one thread each, which end when their parent does."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context, parent_process

__all__ = ["num_cores", "worker_pool"]

# The arrays of one block are too small to share among threads.
_ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "NUMBA")
}


def num_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def worker_pool(workers: int) -> Iterator[Executor]:
    """So many worker processes; one worker is a thread of this process.

    What has not begun when the block is left, is cancelled.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    pool: Executor = ThreadPoolExecutor(1)
    if workers > 1:
        # Read when a worker starts, before it imports numpy.
        os.environ.update(_ONE_THREAD)
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin_worker)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is the parent's
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    """A killed parent tells nobody: without this, its workers would wait for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
