"""Work on several processes: jobs with a weight each, progress by what is done, and a clean end at Ctrl-C.

Under the walk. Jobs are plain functions on plain values; a worker never leaves files that count.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from types import TracebackType
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

#: Told what was finished last, and the share of all work that is done.
Tell = Callable[[str, float], None]

MOST_WORKERS = 4


class Crew:
    """Worker processes, one for each core and at least two; leaving the block by an exception ends them at once."""

    def __init__(self, tell: Tell, expected_s: float) -> None:
        """`expected_s`: sum of the weights of all jobs that will come, in seconds of one core."""
        self._tell, self._expected_s, self._done_s = tell, expected_s, 0.0
        self._others = set(multiprocessing.active_children())
        workers = min(MOST_WORKERS, max(2, len(os.sched_getaffinity(0))))
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker)
        self._open: dict[Future[object], tuple[str, float]] = {}

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=kind is None, cancel_futures=True)
        if kind is not None:
            for child in set(multiprocessing.active_children()) - self._others:
                child.terminate()

    def submit(self, what: str, weight_s: float, job: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Begin `job` as soon as a worker is free; `weight_s` is its share of the progress."""
        future = self._pool.submit(job, *args, **kwargs)
        self._open[future] = (what, weight_s)  # type: ignore[index]
        return future

    def result(self, future: Future[T]) -> T:
        """The result of one job; others that end meanwhile count as progress. Raises what a job raised, at once."""
        while future in self._open:
            done, _ = wait(self._open, timeout=1.0, return_when=FIRST_COMPLETED)
            for ended in done:
                self._count(ended)
        return future.result()

    def _count(self, ended: Future[object]) -> None:
        what, weight_s = self._open.pop(ended)
        ended.result()  # a failure of any job ends the walk, not only of the one that is waited for
        self._done_s += weight_s
        self._tell(what, min(1.0, self._done_s / self._expected_s))


def _start_worker() -> None:
    """Ctrl-C is for the parent, which ends the pool; linear algebra keeps to one thread."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
