"""How long the processes of a soak waited for a processor, by the kernel's own count, and what that may excuse.

Beside everything: looks at /proc. Where a kernel does not count, nothing is excused.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from servod.errors import FaultCode
from servod.soak.explained import Explained
from servod.soak.kinds import fault_bits
from servod.units import NS_PER_S

#: What a loop may see whose processes do not get their turn, and what follows from that.
STARVED = frozenset(
    {
        *(FaultCode.DEADLINE_LATE, FaultCode.DEADLINE_BUDGET, FaultCode.FEEDBACK_STALE, FaultCode.SUPERVISOR_LOST),
        *(FaultCode.NODE_HEARTBEAT_LOST, FaultCode.DRIVE_FAULT, FaultCode.FOLLOWING_ERROR, FaultCode.BUS_QUEUE_FULL),
        *(FaultCode.COMMANDS_LOST, FaultCode.ENCODER_ALARM),
    }
)
#: Processes that waited for so long in all in a piece of the soak [ns] may have missed what the axis bears; its traces
#: may come so much later.
_STARVED_NS, _TRACE_NS = 25_000_000, 500_000_000


class Hunger:
    """Adds up the waiting of changing processes; what a hypervisor takes from the whole machine counts as well."""

    def __init__(self) -> None:
        self._waited_ns: dict[int, int] = {}
        self._stolen_ns = stolen_ns()
        self.total_ns = 0

    def look(self, pids: Iterable[int]) -> int:
        """Take what `pids` waited since the last look, from their beginning if they are new; the total so far [ns]."""
        stolen = stolen_ns()
        self.total_ns += stolen - self._stolen_ns
        self._stolen_ns, known = stolen, self._waited_ns
        self._waited_ns = {pid: waited_ns(pid) for pid in pids}
        self.total_ns += sum(max(0, waited - known.get(pid, 0)) for pid, waited in self._waited_ns.items())
        return self.total_ns


class Starved:
    """The pieces of a soak in which its processes were starved; `explained`: what that may cause, and when."""

    def __init__(self, now_ns: int) -> None:
        self.explained = Explained()
        self._hunger, self._since_ns, self._before_ns = Hunger(), now_ns, 0

    def look(self, pids: Iterable[int], now_ns: int) -> None:
        """End a piece: were `pids` starved since the last look?"""
        total_ns = self._hunger.look(pids)
        if total_ns - self._before_ns > _STARVED_NS:
            self.explained.add(self._since_ns, fault_bits(STARVED), now_ns + _TRACE_NS)
        self._since_ns, self._before_ns = now_ns, total_ns

    def waited_ms(self, pids: Iterable[int]) -> float:
        """How long `pids` waited in the piece that goes on."""
        return (self._hunger.look(pids) - self._before_ns) / 1e6


def waited_ns(pid: int) -> int:
    """Time that all threads of a process stood in a run queue (proc_pid_schedstat(5)); 0 when it has gone."""
    total = 0
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError, ValueError, IndexError):
                total += int((task / "schedstat").read_text().split()[1])
    return total


def stolen_ns() -> int:
    """Time that the hypervisor gave to others while this machine wanted to run (proc_stat(5), steal)."""
    ticks = int(Path("/proc/stat").read_text().split()[8])
    return ticks * NS_PER_S // os.sysconf("SC_CLK_TCK")
