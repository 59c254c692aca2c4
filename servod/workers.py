"""Worker processes for long computations: they leave Ctrl-C to their parent and never outlive it.

Ground floor, for the laboratory part. The daemon and the loop have processes of their own and do not come here.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from collections.abc import Iterator
from functools import cache
from multiprocessing import get_context, resource_tracker
from multiprocessing.pool import Pool
from multiprocessing.util import Finalize

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


@contextlib.contextmanager
def worker_pool(processes: int) -> Iterator[Pool]:
    """`processes` fresh processes for the time of a `with` block; whatever ends the block ends them at once."""
    _tracker_goes_with_us()
    with get_context("spawn").Pool(processes, begin_worker, (os.getpid(),)) as pool:
        yield pool


@cache
def _tracker_goes_with_us() -> None:
    """Wait at our own end for the process in which multiprocessing keeps account of semaphores.

    Left alone it ends after us, and stays listed until whoever inherits it looks. Its end must come after that of all
    semaphores (exit priority 0); that it is waited for in `_stop` alone is why a private name is used.
    """
    stop = resource_tracker._resource_tracker._stop  # type: ignore[attr-defined]
    Finalize(None, stop, exitpriority=-1)


def begin_worker(parent: int) -> None:
    """What a worker of `parent` does first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before we asked
        os._exit(1)
