"""How the loop keeps time over the last seconds: percentiles for `status`, and one line beside every fault.

Around the loop, fed by the supervisor with the records it drained. A value per record goes into rings of fixed size;
sorting happens only when somebody asks.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable

from servod.common.units import NS_PER_S, NS_PER_US
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.status import Percentiles, TimingStatus

WINDOW_S = 10.0
#: A loop that writes no record for so long hangs: at least this time, and at least so many periods.
_HUNG_NS, _HUNG_PERIODS = NS_PER_S, 50
#: After a pause of its own of this length, the watcher knows nothing of the loop and begins again.
_OWN_PAUSE_NS = NS_PER_S // 5
#: A round of the watcher that took longer says no more of the loop than this; so long a machine may stall besides.
_ROUND_NS, _STALL_NS = NS_PER_S // 25, NS_PER_S // 10


class _Ring:
    """The newest values of one quantity, in ns."""

    __slots__ = ("_at", "_new", "_shown", "_values", "filled")

    def __init__(self, capacity: int) -> None:
        self._values = array("q", bytes(8 * capacity))
        self._at = self.filled = 0
        self._new, self._shown = 0, Percentiles(p50_us=0.0, p99_us=0.0, max_us=0.0)

    def add(self, values: Iterable[int]) -> None:
        """Take new values, oldest first."""
        store, at, capacity = self._values, self._at, len(self._values)
        count = self.filled
        for value in values:
            store[at] = value
            at = at + 1 if at + 1 < capacity else 0
            count += 1
        self._new += count - self.filled
        self._at, self.filled = at, min(count, capacity)

    def percentiles(self) -> Percentiles:
        """Median, 99th percentile and maximum; zeros while empty. Sorted when a hundredth of the values is new."""
        if self._new * 100 >= self.filled and self.filled:
            self._new = 0
            ordered = sorted(self._values[: self.filled])
            last = len(ordered) - 1
            self._shown = {
                "p50_us": ordered[last // 2] / 1000.0,
                "p99_us": ordered[last * 99 // 100] / 1000.0,
                "max_us": ordered[last] / 1000.0,
            }
        return self._shown


class Pulse:
    """Whether the loop still writes; a watcher that was itself held up does not blame the loop for it."""

    def __init__(self, period_us: int) -> None:
        self._limit_ns = max(_HUNG_NS, _HUNG_PERIODS * period_us * NS_PER_US)
        self._silent_ns = 0
        self._looked_ns: int | None = None

    def look(self, wrote: bool, now_ns: int) -> None:
        """Once per round: whether records came since the last look."""
        pause_ns = 0 if self._looked_ns is None else now_ns - self._looked_ns
        self._silent_ns = 0 if wrote or pause_ns > _OWN_PAUSE_NS else self._silent_ns + pause_ns
        self._looked_ns = now_ns

    @property
    def stopped(self) -> bool:
        """The loop hangs."""
        return self._silent_ns > self._limit_ns


class StandingLoop:
    """Whether the drive is to be stopped past a loop that stands still, long before that counts as hung.

    A machine may stall for some ten milliseconds, so silence alone is no reason before the drive must have stopped by
    itself. A drive that tells that it misses the loop does, and a load that its brake does not hold yet falls.
    """

    def __init__(self, reaction_s: float) -> None:
        """`reaction_s`: the drive has reacted to a dead master by then, as is stated."""
        self._limit_ns = round(reaction_s * NS_PER_S) + _STALL_NS
        self._silent_ns = 0
        self._looked_ns: int | None = None
        self._misses_loop = self._done = False

    def look(self, wrote: bool, drive_misses_loop: bool, now_ns: int) -> bool:
        """Once per round: whether records came since the last look, and whether the drive told that it misses the loop.

        True once for each standstill: now.
        """
        pause_ns = 0 if self._looked_ns is None else min(now_ns - self._looked_ns, _ROUND_NS)
        self._looked_ns = now_ns
        if wrote:
            # What the drive tells in the round of the last records, the next round without one acts on.
            self._silent_ns, self._misses_loop, self._done = 0, drive_misses_loop, False
            return False
        self._silent_ns += pause_ns
        self._misses_loop = self._misses_loop or drive_misses_loop
        due = not self._done and (self._misses_loop or self._silent_ns > self._limit_ns)
        self._done = self._done or due
        return due


class Health:
    """Timing of the loop over the last WINDOW_S seconds, and the bus's counters."""

    def __init__(self, period_us: int, bus_load: float) -> None:
        capacity = max(1, round(WINDOW_S * 1e6 / period_us))
        self._lag, self._tick, self._torque = _Ring(capacity), _Ring(capacity), _Ring(capacity)
        self._period_s, self.bus_load = period_us * 1e-6, bus_load
        self.latest: CycleRecord | None = None

    def add(self, records: list[CycleRecord]) -> None:
        """Take drained records, oldest first."""
        if records:
            self._lag.add(r.lag_ns for r in records)
            self._tick.add(r.tick_ns for r in records)
            self._torque.add(r.torque_sent_ns for r in records)
            self.latest = records[-1]

    def timing(self, records_lost: int) -> TimingStatus:
        """The part of the status document."""
        return {
            "period_us": round(self._period_s * 1e6),
            "window_s": self._lag.filled * self._period_s,
            "cycle": self.latest.cycle if self.latest else 0,
            "missed": self.latest.missed if self.latest else 0,
            "records_lost": records_lost,
            "lag": self._lag.percentiles(),
            "tick": self._tick.percentiles(),
            "torque": self._torque.percentiles(),
        }

    def line(self) -> str:
        """Latency, jitter and bus health in one line, for the log."""
        if self.latest is None:
            return "no cycle yet"
        lag, tick, now = self._lag.percentiles(), self._tick.percentiles(), self.latest
        return (
            f"lag p50 {lag['p50_us']:.0f} p99 {lag['p99_us']:.0f} max {lag['max_us']:.0f} us, "
            f"tick p99 {tick['p99_us']:.0f} us, missed {now.missed}, feedback age {now.amplifier_age}/"
            f"{now.encoder_age} cycles, queue full {now.bus_queue_full}, error frames {now.bus_error_frames}, "
            f"bus load {self.bus_load:.0%}"
        )
