"""Worker processes for long computations: they leave Ctrl-C to their parent and never outlive it.

Ground floor, for the laboratory part. The daemon and the loop have processes of their own and do not come here.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from collections.abc import Iterator
from multiprocessing import get_context
from multiprocessing.pool import Pool

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


@contextlib.contextmanager
def worker_pool(processes: int) -> Iterator[Pool]:
    """`processes` fresh processes for the time of a `with` block; whatever ends the block ends them at once."""
    with get_context("spawn").Pool(processes, begin_worker, (os.getpid(),)) as pool:
        yield pool


def begin_worker(parent: int) -> None:
    """What a worker of `parent` does first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before we asked
        os._exit(1)
