"""The holding brake of the axis: when it may open, when it must close, and how long each takes.

Beside the axis, which says what it does; here is what the brake does with that. A brake by the drive is sequenced by
the drive, servod waits for it. A brake by an output (0x60FE) is sequenced here: it is open only while the drive gives
torque, and the axis is enabled only when it is open.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from servod.common.units import TWO_PI
from servod.formats.config import AmplifierConfig
from servod.kernels.stopping import REST_S
from servod.runtime.fieldbus.devices import HANDSHAKE_SYNCS, AmplifierFeedback

#: The drive is at rest when its sensor stays within this angle [rad] for REST_S.
_REST_RAD = 2e-4
#: ... or within so many of its counts.
_REST_COUNTS = 2.0


def rest_rad(amplifier: AmplifierConfig) -> float:
    """The angle within which the drive's sensor stays at rest."""
    return max(_REST_RAD, _REST_COUNTS * TWO_PI / (amplifier.counts_per_turn * amplifier.gear_ratio))


class BrakeTimes(NamedTuple):
    """What the axis needs to know of its brake."""

    by_output: bool  # servod sequences it
    release_s: float
    engage_s: float
    rest_rad: float = _REST_RAD

    @classmethod
    def of(cls, amplifier: AmplifierConfig) -> BrakeTimes | None:
        """From the configuration; None for an axis without a brake."""
        brake = amplifier.brake
        if brake.by == "none":
            return None
        return cls(brake.by == "output", brake.release_s, brake.engage_s, rest_rad(amplifier))


class RestWatch:
    """Sees by the drive's own sensor that the joint has come to rest."""

    def __init__(self, period_s: float, rest_rad: float) -> None:
        self._rest_rad, self._rest_cycles = rest_rad, max(1, round(REST_S / period_s))
        self._anchor_rad, self._quiet = 0.0, 0

    def begin(self) -> None:
        """From now on."""
        self._quiet = 0

    def rests(self, amplifier: AmplifierFeedback) -> bool:
        """One cycle; one in which the drive is not heard says nothing of rest."""
        if amplifier.age_cycles:
            return False
        if not abs(amplifier.position_rad - self._anchor_rad) <= self._rest_rad:
            self._anchor_rad, self._quiet = amplifier.position_rad, 0
        self._quiet += 1
        return self._quiet > self._rest_cycles


class HoldingBrake:
    """Counts the brake's times in cycles, and sees in a quick stop when it must close."""

    def __init__(self, times: BrakeTimes, period_s: float, stale_cycles: int) -> None:
        """A drive that is not heard for `stale_cycles` gives no torque that one may wait with."""
        self.by_output, self._stale_cycles = times.by_output, stale_cycles
        #: Torque first: the drive has answered that it holds before the brake opens.
        self.torque_first_cycles = HANDSHAKE_SYNCS
        self.open_cycles = HANDSHAKE_SYNCS + math.ceil(times.release_s / period_s - 1e-9)
        self.engage_cycles = max(1, math.ceil(times.engage_s / period_s - 1e-9))
        self._rest = RestWatch(period_s, times.rest_rad)
        self.closing_cycles: int | None = None  # since the brake was told to close in a quick stop

    def begin_stop(self, closes: bool) -> None:
        """The drive stops the axis: the brake closes when it is at rest, or when nothing more is heard of it.

        `closes`: at once.
        """
        self._rest.begin()
        self.closing_cycles = 0 if closes else None

    def close(self) -> None:
        """It closes now."""
        if self.closing_cycles is None:
            self.closing_cycles = 0

    def watch_stop(self, amplifier: AmplifierFeedback, torque_on: bool, overdue: bool) -> bool:
        """One cycle of a quick stop; True when the brake has closed, or there is no torque left to wait with."""
        rests, unheard = self._rest.rests(amplifier), amplifier.age_cycles >= self._stale_cycles
        if rests or unheard or overdue or not torque_on:
            self.close()
        if self.closing_cycles is None:
            return False
        self.closing_cycles += 1
        return not torque_on or self.closing_cycles > self.engage_cycles
