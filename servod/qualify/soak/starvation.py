"""How long the processes of a soak waited for a processor, by the kernel's own count, and what that may excuse.

Beside everything: looks at /proc. Where a kernel does not count, nothing is excused.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.common.faults import FaultCode
from servod.common.units import NS_PER_S
from servod.qualify.soak.kinds import fault_bits

# --- Excuses ---------------------------------------------------------------------------------------------------------
# Which faults may be seen when: what the schedule injected, and what a starved machine excuses, each for its time.


_OPEN_NS = 2**62


class _Span(NamedTuple):
    begin_ns: int
    end_ns: int
    bits: int


class ExcusedFaults:
    """Spans of time with the fault bits that may be seen in them; `always`: those that may be seen at any time."""

    def __init__(self, always: int = 0) -> None:
        self._always = always
        self._spans: list[_Span] = []

    def add(self, begin_ns: int, bits: int, end_ns: int = _OPEN_NS) -> None:
        """From `begin_ns` on, faults of `bits` have a cause."""
        self._spans.append(_Span(begin_ns, end_ns, bits))

    def end(self, end_ns: int) -> None:
        """What has had no end yet ends now."""
        self._spans = [span._replace(end_ns=min(span.end_ns, end_ns)) for span in self._spans]

    def at(self, times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The bits that may be seen at each of these times."""
        bits = np.full(len(times_ns), self._always, dtype=np.int64)
        for span in self._spans:
            bits[(times_ns >= span.begin_ns) & (times_ns <= span.end_ns)] |= span.bits
        return bits

    def forget(self, before_ns: int) -> None:
        """Every row before this time was checked."""
        self._spans = [span for span in self._spans if span.end_ns >= before_ns]


#: What may be seen where loop or drive do not get their turn: cycles, commands and feedback late, and what follows.
STARVED_CYCLE = frozenset(
    {
        *(FaultCode.DEADLINE_LATE, FaultCode.DEADLINE_BUDGET, FaultCode.FEEDBACK_STALE, FaultCode.FOLLOWING_ERROR),
        *(FaultCode.NODE_HEARTBEAT_LOST, FaultCode.BUS_QUEUE_FULL, FaultCode.COMMANDS_LOST),
    }
)
#: What may be seen where the supervisor does not: nobody feeds the loop, nobody reads heartbeats.
STARVED_SUPERVISOR = frozenset({FaultCode.SUPERVISOR_LOST, FaultCode.NODE_HEARTBEAT_LOST})
#: A process that waited for so long in a piece of the soak [ns] may have missed what the axis bears; its traces may
#: come so much later. Many short waits of many processes are none.
_STARVED_NS, _TRACE_NS = 25_000_000, 500_000_000
#: A loop that waited for a period is late by that alone: it is told, and nothing follows from it [ns].
_LATE_NS = 1_000_000

#: Processes by their id, each with the faults that its waiting may cause.
Processes = Mapping[int, frozenset[FaultCode]]


class Starvation:
    """The pieces of a soak in which one of its processes was starved; `explained`: what that may cause, and when.

    What a hypervisor takes from the whole machine counts for each.
    """

    def __init__(self, now_ns: int) -> None:
        self.explained = ExcusedFaults()
        self._since_ns, self._stolen_ns = now_ns, stolen_ns()
        self._totals_ns: dict[int, int] = {}
        self._piece_ns: Counter[int] = Counter()
        self._causes: dict[int, frozenset[FaultCode]] = {}

    def look(self, processes: Processes, now_ns: int) -> None:
        """End a piece: was one of them starved since the last look?"""
        self._take(processes)
        codes: set[FaultCode] = set()
        for pid, waited in self._piece_ns.items():
            codes |= self._causes[pid] if waited > _STARVED_NS else set()
            codes |= self._causes[pid] & {FaultCode.DEADLINE_LATE} if waited > _LATE_NS else set()
        if codes:
            self.explained.add(self._since_ns, fault_bits(frozenset(codes)), now_ns + _TRACE_NS)
        self._since_ns = now_ns
        self._piece_ns.clear()
        self._causes = dict(processes)

    def is_starved(self, processes: Processes) -> bool:
        """Whether one of them waited for long in the piece that goes on."""
        self._take(processes)
        return max(self._piece_ns.values(), default=0) > _STARVED_NS

    def waited_ms(self, processes: Processes) -> float:
        """How long they waited in the piece that goes on, one after the other: a reaction passes through all."""
        self._take(processes)
        return sum(self._piece_ns.values()) / 1e6

    def _take(self, processes: Processes) -> None:
        """Add what each waited since the last time, from its beginning if it is new."""
        stolen, before = stolen_ns(), self._totals_ns
        self._totals_ns = {pid: waited_ns(pid) for pid in processes}
        self._causes.update(processes)
        for pid, total in self._totals_ns.items():
            self._piece_ns[pid] += max(0, total - before.get(pid, 0)) + stolen - self._stolen_ns
        self._stolen_ns = stolen


def waited_ns(pid: int) -> int:
    """Time that all threads of a process stood in a run queue (proc_pid_schedstat(5)); 0 when it has gone."""
    total = 0
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError, ValueError, IndexError):
                total += int((task / "schedstat").read_text(encoding="utf-8").split()[1])
    return total


def stolen_ns() -> int:
    """Time that the hypervisor gave to others while this machine wanted to run (proc_stat(5), steal)."""
    ticks = int(Path("/proc/stat").read_text(encoding="utf-8").split()[8])
    return ticks * NS_PER_S // os.sysconf("SC_CLK_TCK")
