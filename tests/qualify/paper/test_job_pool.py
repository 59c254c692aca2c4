"""The job pool: results and progress, a failing job ends the walk, leaving by an exception ends the workers."""

from __future__ import annotations

import math
import multiprocessing
import operator
import time

import pytest

from servod.qualify.paper.walk import JobPool


def test_results_come_and_progress_is_what_is_done() -> None:
    told: list[tuple[str, float]] = []
    with JobPool(lambda what, share: told.append((what, share)), 4.0) as pool:
        jobs = [pool.submit(f"job {i}", 1.0, math.sqrt, float(i)) for i in range(4)]
        assert [pool.result(job) for job in jobs] == [math.sqrt(i) for i in range(4)]
    shares = [share for _, share in told]
    assert shares == sorted(shares) and all(0.0 < share <= 1.0 for share in shares)


def test_a_failing_job_ends_the_wait_for_another_and_leaves_no_worker() -> None:
    """Ctrl-C leaves the block the same way: by an exception."""
    before = set(multiprocessing.active_children())
    started = time.monotonic()
    with pytest.raises(ZeroDivisionError), JobPool(lambda _what, _share: None, 2.0) as pool:
        slow = pool.submit("slow", 1.0, time.sleep, 60.0)
        pool.submit("fails", 1.0, operator.truediv, 1.0, 0.0)
        pool.result(slow)
    while set(multiprocessing.active_children()) - before and time.monotonic() - started < 30.0:
        time.sleep(0.1)
    assert not set(multiprocessing.active_children()) - before
    assert time.monotonic() - started < 50.0
