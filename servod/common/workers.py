"""Worker processes for long computations: they leave Ctrl-C to their parent and never outlive it.

Ground floor, for the laboratory part. The daemon and the loop have processes of their own and do not come here.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from multiprocessing import active_children, get_context, resource_tracker
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from typing import Any

from servod.common.errors import Unreachable
from servod.common.portable import end_with_parent

#: What Windows can wait for at once, less what the executor itself needs.
_MOST_ON_WINDOWS = 61
#: How long the account of semaphores may take to close [s].
_TRACKER_S = 2.0


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
    semaphores (exit priority 0). Newer Pythons wait for it themselves.
    """
    if not hasattr(resource_tracker.ResourceTracker, "__del__"):
        Finalize(None, _end_tracker, exitpriority=-1)


def _end_tracker() -> None:
    """Close the pipe on which the tracker lives, and reap it; whatever else we started has ended by then."""
    descriptor = resource_tracker.getfd()
    if descriptor is not None:
        os.close(descriptor)
    deadline = time.monotonic() + _TRACKER_S
    with contextlib.suppress(ChildProcessError):  # none is left
        while time.monotonic() < deadline:
            if os.waitpid(-1, os.WNOHANG) == (0, 0):
                time.sleep(0.005)


def begin_worker(parent: int, begin: Callable[..., None] | None = None, given: tuple[Any, ...] = ()) -> None:
    """What a worker of `parent` does first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(parent)
    if begin is not None:
        begin(*given)


# The signals that ask a process of servod to end in order. Ground floor.


#: What ends a process from outside: SIGTERM, and SIGHUP where a terminal sends one.
END_SIGNALS = tuple(s for s in signal.Signals if s.name in ("SIGTERM", "SIGHUP"))


def on_end_signals(act: Callable[[], None]) -> None:
    """Let SIGTERM, SIGINT and SIGHUP (its terminal closes) call `act`; under nohup(1), SIGHUP stays ignored."""
    for number in (*END_SIGNALS, signal.SIGINT):
        if number.name != "SIGHUP" or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: act())
