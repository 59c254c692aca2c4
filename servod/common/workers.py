"""Worker processes for long computations: they leave Ctrl-C to their parent and never outlive it.

Ground floor, for the laboratory part. The daemon and the loop have processes of their own and do not come here.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from multiprocessing import active_children, get_context, resource_tracker
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

from servod.common.errors import Unreachable
from servod.common.portable import end_with_parent

#: What Windows can wait for at once, less what the executor itself needs.
_MOST_ON_WINDOWS = 61


@contextlib.contextmanager
def worker_pool(processes: int, begin: Callable[..., None] | None = None, *given: Any) -> Iterator[Executor]:
    """`processes` fresh processes for the time of a `with` block; whatever ends the block ends them at once.

    Each calls `begin(*given)` first. Raises Unreachable when one of them dies, which an executor tells to whoever waits
    for a result: a `multiprocessing.Pool` would replace it in silence and wait for what it had taken.
    """
    if sys.platform == "win32":
        processes = min(processes, _MOST_ON_WINDOWS)
    _tracker_goes_with_us()
    before = active_children()
    pool = ProcessPoolExecutor(processes, get_context("spawn"), begin_worker, (os.getpid(), begin, given))
    try:
        yield pool
    except BrokenProcessPool:
        raise Unreachable(
            "a worker process ended before its work was done: it could not start, was killed, or memory ran out "
            "(`dmesg` tells); run the command again, with fewer --processes where it has them"
        ) from None
    finally:
        _end(pool, [p for p in active_children() if p not in before])


def _end(pool: ProcessPoolExecutor, workers: Iterable[BaseProcess]) -> None:
    """Kill and wait. The pool's own way out lets every job that has begun come to its end (until Python 3.14)."""
    for process in workers:
        process.kill()
    pool.shutdown(wait=True, cancel_futures=True)


@cache
def _tracker_goes_with_us() -> None:
    """Wait at our own end for the process in which multiprocessing keeps account of semaphores.

    Left alone it ends after us, and stays listed until whoever inherits it looks. Its end must come after that of all
    semaphores (exit priority 0). Newer Pythons wait for it themselves, and Windows has none.
    """
    if sys.platform != "win32" and not hasattr(resource_tracker.ResourceTracker, "__del__"):
        before = _children()
        descriptor = resource_tracker.getfd()  # starts it, as the first semaphore would
        started = _children() - before
        if descriptor is not None and len(started) == 1:
            Finalize(None, _end_tracker, (descriptor, *started), exitpriority=-1)


def _children() -> set[int]:
    """Process ids of our children (proc(5), task/children); empty where the system does not tell."""
    with contextlib.suppress(OSError):
        return set(map(int, Path(f"/proc/self/task/{os.getpid()}/children").read_text(encoding="utf-8").split()))
    return set()


def _end_tracker(descriptor: int, tracker: int) -> None:
    """Close the pipe on which the tracker lives, and reap it."""
    os.close(descriptor)
    with contextlib.suppress(ChildProcessError):
        os.waitpid(tracker, 0)


def begin_worker(parent: int, begin: Callable[..., None] | None = None, given: tuple[Any, ...] = ()) -> None:
    """What a worker of `parent` does first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(parent)
    if begin is not None:
        begin(*given)
