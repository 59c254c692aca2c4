"""A busy program on one core, above the loop's priority: `python -m servod.qualify.faults.cpu_load BUSY_MS IDLE_MS
FOR_MS CORE`.

Beside everything; what an interrupt storm, a backup or a badly written driver does to the core of the loop. Without the
right to real-time scheduling it is an ordinary program, as the loop is then one too.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time

_PRIORITY = 95


def take_core(busy_s: float, idle_s: float, for_s: float) -> None:
    """Compute for `busy_s`, sleep for `idle_s`, and again, until `for_s` have passed."""
    end = time.monotonic() + for_s
    while time.monotonic() < end:
        until = time.monotonic() + busy_s
        while time.monotonic() < until:
            pass
        time.sleep(idle_s)


def main() -> None:
    """Take what the system gives, and run."""
    busy_ms, idle_ms, for_ms, *core = map(int, sys.argv[1:])
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, set(core) or os.sched_getaffinity(0))
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    take_core(busy_ms / 1e3, idle_ms / 1e3, for_ms / 1e3)


if __name__ == "__main__":
    main()
