"""A loop that swings by itself: its torque goes to and fro by as much as its limit, more often than the reference asks.

Neither speed nor following error need ever pass a limit there: a loop that its delay, its torque rate or a loose
coupling makes unstable swings with what the torque can do. Turning points are counted as in the rainflow count of
fatigue (ASTM E1049), with a least range; those that the reference asks for are taken off, all are forgotten in time.
It rather misses a swing than stops a sound axis: friction that reverses, cogging and a poorly damped step stay below.
"""

from __future__ import annotations

import math

#: Turning points that the reference did not ask for, until the loop swings by itself. Each is a swing by the least
#: range; a step response with a damping ratio of 0.06 has seven of half the first one, one of 0.1 has four.
MOST_TURNS = 6.0
#: So many are forgotten in each second: a push now and then is no oscillation.
_FORGOTTEN_PER_S = 0.5
#: Turns that come faster count as one in this time: what a stiff coupling rings with after a step is gone by then.
_APART_S = 0.015
#: What one turn of the reference may make the torque do: there and back; and the most that is granted ahead.
_ASKED_TURNS, _MOST_CREDIT = 2.0, 3.0
#: Turns of the reference are those of its acceleration by this share of the greatest one of late.
_TURN_SHARE = 0.25
_OF_LATE_S = 0.2
#: A step starts all afresh, but no sooner than this after the last that did; else it is a turn of the reference.
_STEP_EVERY_S = 1.0
#: Torque that is injected on purpose makes the law swing too: from this share of the least range on, and this long.
_INJECTED_SHARE, _INJECTED_S = 0.1, 0.2
#: Turns between which the reference has gone on so far [rad, m] are those of a load over the position: a weight that
#: turns, a slope. So slow a swing at speed shows in the following error.
_LOAD_WAY = 1.0
#: Less than that is rounding: acceleration, speed and jump of a reference, in rad or m and s.
_LEAST_ACCELERATION, _LEAST_SPEED, _LEAST_JUMP = 1e-3, 1e-6, 1e-9


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

    def __init__(self, swing_nm: float | None) -> None:
        """`swing_nm`: the least peak-to-peak torque that counts; None: the torque that a joint at rest may have."""
        self._configured_nm = swing_nm
        self.begin(0.0, math.inf)

    def begin(self, position: float, limit_nm: float) -> None:
        """Nothing was counted: at an enable and a change of the law; the reference is at `position`, and the torque
        limit at rest is `limit_nm`, as the way to rest may have narrowed it."""
        self._swing_nm = limit_nm if self._configured_nm is None else self._configured_nm
        self._since_step_s, self._injected, self._velocity = math.inf, 0.0, 0.0
        self._forget(position)

    def _forget(self, position: float) -> None:
        self._torque, self._acceleration, self._level = Turns(), Turns(), 0.0
        self._since_turn_s = _APART_S
        self._greatest = self._last_size = self._last_way = 0.0
        self._position, self._reversed = position, False
        self._turned_at = position

    def look(self, torque_nm: float, position: float, velocity: float, dt_s: float, injected_nm: float = 0.0) -> bool:
        """One cycle: the torque that went out, the reference, rad and rad/s, and what of the torque somebody injects.
        True while it swings by itself."""
        if injected_nm or self._injected:
            self._injected = max(abs(injected_nm), self._injected * (1.0 - min(dt_s / _INJECTED_S, 1.0)))
            if self._injected > _INJECTED_SHARE * self._swing_nm:
                self._forget(position)
                self._velocity = velocity
            elif injected_nm == 0.0:
                self._injected = 0.0
        self._since_step_s += dt_s
        level = self._level
        forgotten = _FORGOTTEN_PER_S * dt_s
        level = max(0.0, level - forgotten) if level > 0.0 else min(0.0, level + forgotten)
        jumps = velocity == self._velocity == 0.0 and abs(position - self._position) > _LEAST_JUMP
        if jumps:
            afresh = self._since_step_s >= _STEP_EVERY_S
            level = (min(level, 0.0) if afresh else level) - _ASKED_TURNS
            self._since_step_s = 0.0 if afresh else self._since_step_s
        elif self._asked(velocity, dt_s):
            level -= _ASKED_TURNS
        self._position, self._velocity = position, velocity
        level = max(level, -_MOST_CREDIT)
        self._since_turn_s += dt_s
        if self._torque.step(torque_nm, self._swing_nm) and self._since_turn_s >= _APART_S:
            level += 1.0 if abs(position - self._turned_at) < _LOAD_WAY else 0.0
            self._since_turn_s, self._turned_at = 0.0, position
        self._level = level
        return level >= MOST_TURNS

    def _asked(self, velocity: float, dt_s: float) -> bool:
        """A turn of the reference: it reverses, or its acceleration turns; of one turn both count once."""
        acceleration = (velocity - self._velocity) / dt_s
        # A jump of the velocity, as at the start of a table, is one cycle's and no scale for what follows.
        size, self._last_size = min(abs(acceleration), self._last_size), abs(acceleration)
        self._greatest = size if size > self._greatest else self._greatest * (1.0 - min(dt_s / _OF_LATE_S, 1.0))
        turned = self._acceleration.step(acceleration, max(_TURN_SHARE * self._greatest, _LEAST_ACCELERATION))
        if abs(velocity) > _LEAST_SPEED:
            reverses = velocity * self._last_way < 0.0
            self._last_way = velocity
            if reverses:
                self._reversed = True
                return True
        if not turned:
            return False
        of_a_reversal, self._reversed = self._reversed, False
        return not of_a_reversal
