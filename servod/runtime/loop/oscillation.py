"""A loop that swings by itself: its torque goes to and fro by a good part of its limit, more often than the reference
asks.

Neither speed nor following error need ever pass a limit there: a loop that its delay, its torque rate or a loose
coupling makes unstable swings with what the torque can do. Turning points are counted as in the rainflow count of
fatigue (ASTM E1049), with a least range; those that the reference asks for are taken off, all are forgotten in time.
"""

from __future__ import annotations

import math

from servod.formats.config import LimitsConfig

#: Turning points that the reference did not ask for, until the loop swings by itself; a step response that dies away
#: has fewer of the least range.
MOST_TURNS = 6.0
#: So many are forgotten in each second: a push now and then is no oscillation.
_FORGOTTEN_PER_S = 0.5
#: Turns that come faster count as one in this time: what rings down after a step is gone by then.
_APART_S = 0.015
#: What one turn of the reference may make the torque do: there and back; and the most that is granted ahead.
_ASKED_TURNS, _MOST_CREDIT = 2.0, 3.0
#: Of limits.torque_nm, where limits.oscillation_nm is left out.
_SWING_SHARE = 0.5
#: Turns of the reference are those of its acceleration by this share of the greatest one of late.
_TURN_SHARE = 0.25
_OF_LATE_S = 0.2
#: Less than that is rounding: acceleration, speed and jump of a reference, in rad or m and s.
_LEAST_ACCELERATION, _LEAST_SPEED, _LEAST_JUMP = 1e-3, 1e-6, 1e-9


def least_swing_nm(limits: LimitsConfig) -> float:
    """The peak-to-peak torque from which on a swing counts, N*m."""
    return _SWING_SHARE * limits.torque_nm if limits.oscillation_nm is None else limits.oscillation_nm


class Turns:
    """Finds the turning points of a signal that are at least some range apart."""

    __slots__ = ("_extreme", "_rises")

    def __init__(self) -> None:
        """Nothing was seen."""
        self._extreme, self._rises = -math.inf, True

    def step(self, value: float, least_range: float) -> bool:
        """Whether the signal has come back from its last extreme by more than `least_range`: it turned there."""
        back = self._extreme - value if self._rises else value - self._extreme
        if back > least_range:
            self._extreme, self._rises = value, not self._rises
            return True
        if back < 0.0:
            self._extreme = value
        return False


class Oscillation:
    """Counts the turns of the torque against those of the reference, cycle by cycle."""

    def __init__(self, swing_nm: float) -> None:
        """`swing_nm`: the least peak-to-peak torque that counts."""
        self._swing_nm = swing_nm
        self.begin(0.0)

    def begin(self, position: float) -> None:
        """At enable, the reference at `position`: nothing was counted."""
        self._torque, self._acceleration, self._level = Turns(), Turns(), 0.0
        self._since_turn_s = _APART_S
        self._greatest = self._last_velocity = 0.0
        self._last_position = position

    def look(self, torque_nm: float, position: float, velocity: float, acceleration: float, dt_s: float) -> bool:
        """One cycle: torque that went out, without what was injected on purpose, and the reference in rad, rad/s,
        rad/s^2. True while the loop swings by itself.
        """
        size = abs(acceleration)
        self._greatest = size if size > self._greatest else self._greatest * (1.0 - dt_s / _OF_LATE_S)
        asked = self._acceleration.step(acceleration, max(_TURN_SHARE * self._greatest, _LEAST_ACCELERATION))
        if abs(velocity) > _LEAST_SPEED:
            asked = asked or velocity * self._last_velocity < 0.0  # it reverses, and so does friction
            self._last_velocity = velocity
        elif abs(position - self._last_position) > _LEAST_JUMP:
            asked = True
        self._last_position = position
        level = self._level
        if level > 0.0:
            level = max(0.0, level - _FORGOTTEN_PER_S * dt_s)
        elif level < 0.0:
            level = min(0.0, level + _FORGOTTEN_PER_S * dt_s)
        if asked:
            level = max(-_MOST_CREDIT, level - _ASKED_TURNS)
        self._since_turn_s += dt_s
        if self._torque.step(torque_nm, self._swing_nm) and self._since_turn_s >= _APART_S:
            level, self._since_turn_s = level + 1.0, 0.0
        self._level = level
        return level >= MOST_TURNS
