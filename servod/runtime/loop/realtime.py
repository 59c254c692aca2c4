"""Everything real-time that is asked of the operating system, each answered with granted or refused and the reason.

Called by the loop process before its first cycle, and behind its last. Nothing here is needed for the loop to run; all
of it is needed for it to run on time, so a refusal is reported, never swallowed.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
from pathlib import Path
from typing import NamedTuple

_MCL_CURRENT, _MCL_FUTURE = 1, 2  # sys/mman.h
_PR_SET_TIMERSLACK = 29  # linux/prctl.h
#: Holding this device open with a latency of 0 us keeps the cores out of sleep states (kernel: pm_qos_interface).
_CPU_LATENCY_DEVICE = Path("/dev/cpu_dma_latency")


class Grant(NamedTuple):
    """One request to the operating system: what it was, whether it was granted, and the value or the reason."""

    name: str
    granted: bool
    reason: str


def apply_realtime(cpu: int | None, priority: int) -> list[Grant]:
    """Pin to `cpu`, lock memory, ask for SCHED_FIFO at `priority` (0: leave the scheduler), freeze the collector."""
    return [
        _affinity(cpu),
        _lock_memory(),
        _timer_slack(),
        _cpu_latency(),
        _fifo(priority),
        _freeze_collector(),
    ]


def give_way() -> None:
    """Leave SCHED_FIFO: the interpreter's end takes 30 ms, in which the loop of another axis on this core shall run."""
    with contextlib.suppress(OSError):  # refused, the end takes its time from others, and is an end all the same
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _affinity(cpu: int | None) -> Grant:
    if cpu is None:
        return Grant("cpu_affinity", False, "not asked for (cycle.cpu)")
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        return Grant("cpu_affinity", False, f"core {cpu}: {error.strerror}")
    return Grant("cpu_affinity", True, f"core {cpu}")


def _libc_call(name: str, what: str, *arguments: int) -> Grant:
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, what)(*arguments) == 0:
        return Grant(name, True, what)
    return Grant(name, False, os.strerror(ctypes.get_errno()))


def _lock_memory() -> Grant:
    return _libc_call("memory_lock", "mlockall", _MCL_CURRENT | _MCL_FUTURE)


def _timer_slack() -> Grant:
    """Without FIFO the kernel may delay a wake-up by 50 us; ask for 1 ns."""
    return _libc_call("timer_slack", "prctl", _PR_SET_TIMERSLACK, 1, 0, 0, 0)


def _cpu_latency() -> Grant:
    """The request lasts as long as the descriptor; it is left open for the life of the process."""
    try:
        device = os.open(_CPU_LATENCY_DEVICE, os.O_WRONLY)
        os.write(device, bytes(4))
    except OSError as error:
        return Grant("cpu_latency", False, f"{_CPU_LATENCY_DEVICE}: {error.strerror}")
    return Grant("cpu_latency", True, "0 us")


def _fifo(priority: int) -> Grant:
    if priority == 0:
        return Grant("sched_fifo", False, "not asked for (cycle.priority is 0)")
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return Grant("sched_fifo", False, f"priority {priority}: {error.strerror} (needs CAP_SYS_NICE or LimitRTPRIO)")
    return Grant("sched_fifo", True, f"priority {priority}")


def _freeze_collector() -> Grant:
    """The cycle makes no reference cycles; a collection in it would only cost time (up to 300 ms were seen)."""
    gc.collect()
    gc.freeze()
    gc.disable()
    return Grant("gc_frozen", True, f"{gc.get_freeze_count()} objects")
