"""Deadlines of the virtual world in one queue: heartbeats, event timers, time-outs, servo ticks.

Stands below nodes and hub. It has no clock of its own: the world fires what is due, on wall or virtual time alike.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush

#: Later than any moment that occurs.
NEVER = 1 << 62


class Timer:
    """One deadline that can be moved. Moving it later costs no queue operation, so that a watchdog may be re-armed
    with every frame."""

    __slots__ = ("_callback", "_queued_ns", "_timeline", "due_ns")

    def __init__(self, timeline: Timeline, callback: Callable[[int], None]) -> None:
        self._timeline, self._callback = timeline, callback
        self._queued_ns = NEVER
        self.due_ns = NEVER

    def arm(self, due_ns: int) -> None:
        """Call back at `due_ns`, replacing an earlier deadline."""
        self.due_ns = due_ns
        if due_ns < self._queued_ns:
            self._queued_ns = due_ns
            self._timeline.push(due_ns, self)

    def cancel(self) -> None:
        """Forget the deadline."""
        self.due_ns = NEVER

    @property
    def armed(self) -> bool:
        """True while a deadline stands."""
        return self.due_ns != NEVER

    def popped(self, queued_ns: int) -> None:
        """The queue's entry of `queued_ns` came up: call back when it is still the deadline, else queue again."""
        if queued_ns != self._queued_ns:
            return
        self._queued_ns = NEVER
        due_ns = self.due_ns
        if due_ns > queued_ns:
            if due_ns != NEVER:
                self.arm(due_ns)
            return
        self.due_ns = NEVER
        self._callback(due_ns)


class Timeline:
    """The queue of deadlines, earliest first; ties in the order of arming."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Timer]] = []
        self._serial = 0
        self.now_ns = 0  # of the event that is being served

    def timer(self, callback: Callable[[int], None]) -> Timer:
        """A new timer, not armed; `callback` gets the deadline in ns."""
        return Timer(self, callback)

    def push(self, due_ns: int, timer: Timer) -> None:
        """Queue `timer` for `due_ns` (for Timer.arm)."""
        self._serial += 1
        heappush(self._heap, (due_ns, self._serial, timer))

    def next_ns(self) -> int:
        """The earliest deadline, NEVER when there is none."""
        return self._heap[0][0] if self._heap else NEVER

    def fire_next(self) -> None:
        """Take the earliest entry and let its timer act."""
        due_ns, _, timer = heappop(self._heap)
        self.now_ns = due_ns
        timer.popped(due_ns)
