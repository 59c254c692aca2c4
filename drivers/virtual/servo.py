"""The amplifier's own inner loops: velocity control, position control, set-point profile, braking.

Used outside cyclic synchronous torque: in csv, csp and pp, and for every stop that the drive makes by itself. They run
on the drive's servo tick, in SI units of the joint.
"""

from __future__ import annotations

import math

from servod.common.units import NS_PER_S, TWO_PI
from servod.drivers.virtual.power_state import Ramp

TICK_NS = 500_000
TICK_S = TICK_NS / NS_PER_S
_VELOCITY_BANDWIDTH = TWO_PI * 30.0  # 1/s
_INTEGRAL_RATE = 40.0  # 1/s
_POSITION_GAIN = 20.0  # 1/s
#: At rest is slower than this [rad/s] for so many ticks.
_REST_RAD_S, _REST_TICKS = 0.02, 4
#: A stop that is not at rest after its ramp and this time [s] counts as done: the load drives the axis.
_STOP_GRACE_S = 0.1


class VelocityLoop:
    """PI control of the velocity; tuned from the inertia that the drive was commissioned with."""

    def __init__(self, inertia: float) -> None:
        self._gain = inertia * _VELOCITY_BANDWIDTH
        self._integral_nm = 0.0

    def reset(self, torque_nm: float) -> None:
        """Take over at the torque now produced."""
        self._integral_nm = torque_nm

    def torque_nm(self, wanted_rad_s: float, actual_rad_s: float, limit_nm: float) -> float:
        """One tick; the integral part stays within `limit_nm`."""
        error = wanted_rad_s - actual_rad_s
        integral = self._integral_nm + self._gain * _INTEGRAL_RATE * error * TICK_S
        self._integral_nm = min(max(integral, -limit_nm), limit_nm)
        return self._integral_nm + self._gain * error

    def brake_nm(self, actual_rad_s: float) -> float:
        """Torque of short-circuited windings: against the velocity, nothing stored."""
        return -self._gain * actual_rad_s


def position_to_velocity(error_rad: float) -> float:
    """The proportional position loop of csp and pp."""
    return _POSITION_GAIN * error_rad


class Brake:
    """A stop under way: its velocity ramp, and when it is done."""

    def __init__(self, ramp: Ramp, velocity_rad_s: float, deceleration_rad_s2: float, resolution_rad_s: float) -> None:
        self.ramp = ramp
        self._wanted = velocity_rad_s if ramp in (Ramp.SLOW_DOWN, Ramp.QUICK_STOP) else 0.0
        self._step = deceleration_rad_s2 * TICK_S
        self._rest_rad_s = max(_REST_RAD_S, resolution_rad_s)
        self._quiet = 0
        self._left_s = abs(velocity_rad_s) / deceleration_rad_s2 + _STOP_GRACE_S
        self.done = False

    def wanted_rad_s(self, actual_rad_s: float) -> float:
        """Advance one tick: the velocity to follow. Sets `done` when the axis is at rest or the time is up."""
        wanted = self._wanted
        self._wanted = math.copysign(max(abs(wanted) - self._step, 0.0), wanted)
        self._left_s -= TICK_S
        slow = self._wanted == 0.0 and abs(actual_rad_s) < self._rest_rad_s
        self._quiet = self._quiet + 1 if slow else 0
        self.done = self.done or self._quiet >= _REST_TICKS or self._left_s <= 0.0
        return self._wanted


class Profile:
    """Set-point generator of profile position mode: a trapezoid of velocity towards `target_rad`."""

    def __init__(self, position_rad: float) -> None:
        self.position_rad = self.target_rad = position_rad
        self.velocity_rad_s = 0.0

    def advance(self, velocity_rad_s: float, acceleration_rad_s2: float, deceleration_rad_s2: float) -> None:
        """One tick with the limits of 0x6081, 0x6083 and 0x6084."""
        left = self.target_rad - self.position_rad
        allowed = min(velocity_rad_s, math.sqrt(2.0 * deceleration_rad_s2 * abs(left)), abs(left) / TICK_S)
        wanted = math.copysign(allowed, left)
        step = acceleration_rad_s2 * TICK_S if abs(wanted) > abs(self.velocity_rad_s) else math.inf
        self.velocity_rad_s += min(max(wanted - self.velocity_rad_s, -step), step)
        self.position_rad += self.velocity_rad_s * TICK_S

    @property
    def reached(self) -> bool:
        """True when the generator stands at its target."""
        return self.position_rad == self.target_rad or abs(self.target_rad - self.position_rad) < 1e-9
