"""Independent jobs of a step, side by side in worker processes, with progress by the jobs that are done.

Under the steps that tune and measure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from servod.common.workers import worker_pool
from servod.lab.commission.walk import Tell

T = TypeVar("T")


def run_jobs(
    work: Callable[..., T], jobs: Sequence[tuple[Any, ...]], names: Sequence[str], processes: int, tell: Tell
) -> list[T]:
    """`work(*job)` for every job, in their order. Raises what the first job that fails raises."""
    tell(", ".join(names[:processes]), 0.0)
    with worker_pool(min(processes, len(jobs))) as pool:
        pending = [pool.submit(work, *job) for job in jobs]
        results = []
        for index, result in enumerate(pending):
            results.append(result.result())
            tell(", ".join(names[index + 1 : index + 1 + processes]) or names[-1], (index + 1) / len(jobs))
    return results
