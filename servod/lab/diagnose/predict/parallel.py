"""Runs simulations on both cores: kernels that let go of the interpreter's lock, and threads that call them.

Stands between the predictor and the fit. Threads, not processes: recordings and Jacobians are large and shared.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

from servod.kernels.physics.compiled import Kernel, available, compiled

T = TypeVar("T")
R = TypeVar("R")

#: Cores that a diagnosis uses, at most.
MOST_CORES = 2


@cache
def released(function: Kernel) -> Kernel:
    """`function` compiled, and called without the interpreter's lock; in pure Python where there is no compiler."""
    if not available():
        return function
    import numba

    kernel = compiled(function)

    def call(*arguments: Any) -> None:
        kernel(*arguments)

    outer: Kernel = numba.njit(nogil=True)(call)
    return outer


@cache
def cores() -> int:
    """Cores that this process may use, MOST_CORES at most; SERVOD_CORES overrides."""
    asked = os.environ.get("SERVOD_CORES", "")
    return int(asked) if asked.isdigit() and int(asked) > 0 else min(MOST_CORES, len(os.sched_getaffinity(0)))


@cache
def _pool(level: str) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=cores(), thread_name_prefix=level)


def side_by_side(level: str, function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """`function` of every item, in order. Calls within calls need another `level`, lest they wait for each other."""
    if cores() == 1:
        return [function(item) for item in items]
    return list(_pool(level).map(function, items))
