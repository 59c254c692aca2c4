"""Time as a parameter: the wall clock of a real bus, or the virtual world's own time.

Stands on nothing. Absolute deadlines only; nobody below the supervisor asks the operating system for the time directly.
"""

from __future__ import annotations

import time
from typing import Protocol

from servod.common.units import NS_PER_S


class Clock(Protocol):
    """Monotonic nanoseconds, and sleeping until a moment on the same scale."""

    def now_ns(self) -> int:
        """Present time."""
        ...

    def sleep_until(self, deadline_ns: int) -> None:
        """Return at or after `deadline_ns`; at once when it is past."""
        ...


class WallClock:
    """CLOCK_MONOTONIC."""

    def now_ns(self) -> int:
        """Present time."""
        return time.monotonic_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleep; Python's sleep on Linux is clock_nanosleep and survives signals."""
        remaining = deadline_ns - time.monotonic_ns()
        if remaining > 0:
            time.sleep(remaining / NS_PER_S)
