"""The amplifier's own torque limits, in the order of the standard, and its motor protection.

Between the torque demand of any mode and the power stage. Everything in per mille of rated torque; torque and current
are taken as proportional, as in a synchronous motor below field weakening.
"""

from __future__ import annotations

from servod.drivers.virtual.dictionary import Dictionary
from servod.runtime.fieldbus.cia import Obj402

RATED_PERMILLE = 1000
#: Thermal reserve: (torque/rated)^2 - 1, integrated over time in s; at this much the torque falls back to rated.
THERMAL_RESERVE_S = 20.0


class TorqueLimits:
    """Clamps a demand; `limited` says whether the last one was changed (status word bit 11)."""

    def __init__(self, dictionary: Dictionary) -> None:
        entry = dictionary.entry
        self._max_torque = entry(Obj402.MAX_TORQUE)
        self._positive = entry(Obj402.POSITIVE_TORQUE_LIMIT)
        self._negative = entry(Obj402.NEGATIVE_TORQUE_LIMIT)
        self._max_current = entry(Obj402.MAX_CURRENT)
        self._max_speed = entry(Obj402.MAX_MOTOR_SPEED)
        self._heat_s = 0.0
        self._folded_back = False
        self.limited = False

    @property
    def hot(self) -> bool:
        """True while the motor protection holds the torque at its rated value (warning, status word bit 7)."""
        return self._folded_back

    def clamp(self, demand: float, motor_speed_rpm: float, stopping: bool) -> int:
        """The torque produced: 0x6072, then 0x60E0/0x60E1 (not in a quick stop), 0x6073, thermal, speed guard."""
        high = low = self._max_torque.value
        if not stopping:
            high = min(high, self._positive.value)
            low = min(low, self._negative.value)
        current = RATED_PERMILLE if self._folded_back else self._max_current.value
        high, low = min(high, current), min(low, current)
        speed = self._max_speed.value
        if motor_speed_rpm > speed:
            high = 0
        elif motor_speed_rpm < -speed:
            low = 0
        wanted = round(demand)
        produced = high if wanted > high else -low if wanted < -low else wanted
        self.limited = produced != wanted
        return produced

    def warm(self, produced: int, duration_s: float) -> None:
        """Account `duration_s` at `produced` for the motor protection."""
        ratio = produced / RATED_PERMILLE
        self._heat_s += (ratio * ratio - 1.0) * duration_s
        if self._heat_s <= 0.0:
            self._heat_s = 0.0
            self._folded_back = False
        elif self._heat_s >= THERMAL_RESERVE_S:
            self._folded_back = True
