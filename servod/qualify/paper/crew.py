"""Work on several processes: jobs with a weight each, progress by what is done, and a clean end at Ctrl-C.

Under the walk; the processes are those of servod.common.workers. Jobs are plain functions on plain values; a worker
never leaves files that count.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from servod.common.portable import usable_cores
from servod.common.workers import worker_pool

P = ParamSpec("P")
T = TypeVar("T")

#: Told what was finished last, and the share of all work that is done.
Tell = Callable[[str, float], None]

MOST_WORKERS = 4
_POLL_S = 0.05


class Crew:
    """Worker processes, one for each core and at least two; leaving the block ends them at once."""

    def __init__(self, tell: Tell, expected_s: float) -> None:
        """`expected_s`: sum of the weights of all jobs that will come, in seconds of one core."""
        self._tell, self._expected_s, self._done_s = tell, expected_s, 0.0
        self._stack = ExitStack()
        self._open: dict[Future[Any], tuple[str, float]] = {}

    def __enter__(self) -> Crew:
        workers = min(MOST_WORKERS, max(2, usable_cores()))
        self._pool = self._stack.enter_context(worker_pool(workers))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def submit(self, what: str, weight_s: float, job: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Begin `job` as soon as a worker is free; `weight_s` is its share of the progress."""
        pending = self._pool.submit(job, *args, **kwargs)
        self._open[pending] = (what, weight_s)
        return pending

    def result(self, pending: Future[T]) -> T:
        """The result of one job; others that end meanwhile count as progress. Raises what a job raised, at once."""
        while pending in self._open:
            ended = [job for job in self._open if job.done()]
            for job in ended:
                self._count(job)
            if not ended:
                time.sleep(_POLL_S)
        return pending.result()

    def _count(self, ended: Future[Any]) -> None:
        what, weight_s = self._open.pop(ended)
        ended.result()  # a failure of any job ends the walk, not only of the one that is waited for
        self._done_s += weight_s
        self._tell(what, min(1.0, self._done_s / self._expected_s))
