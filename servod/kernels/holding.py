"""Holding: how much torque something is proven to take off a joint's motion, each way; a load that hangs on it, say.

Plain floats, once a cycle, for the limits (servod.runtime.loop.limits). What may hang on a joint need not: only what
the joint did under the torque of the last cycles tells. Newton's law with the second difference of the position, over a
window that is longer than noise and delay: the torque counts with the same weights, and by the worst of the delays that
may lie between command and position.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from servod.kernels.stopping import StopFacts

#: Half the window: a lighter joint shows a torque of which nothing holds it by so many cycles squared.
_HALF_CYCLES = 8
#: A command acts on the position that is seen up to so many cycles later.
_MOST_DELAY_CYCLES = 4
#: Cycles that differ in length by more were late, or skipped some.
_UNEVEN_SHARE = 0.2
#: Proof that is older counts no more: frames are lost, and the load may be gone.
_KEPT_CYCLES = 50


class Proof(NamedTuple):
    """What opposes motion up and down at least [N*m], and the mean speed over the window."""

    up_nm: float = 0.0
    down_nm: float = 0.0
    speed_rad_s: float = 0.0


class Holding:
    """The last cycles of one joint. What opposes it is taken for what it was a window ago, and for no more than what
    the facts say that load and least friction are."""

    def __init__(self, facts: StopFacts) -> None:
        self._least, self._most = facts.least_inertia, facts.most_inertia
        self._most_up_nm = facts.friction_nm - facts.load_min_nm if facts.load_min_nm else 0.0
        self._most_down_nm = facts.friction_nm + facts.load_max_nm if facts.load_max_nm else 0.0
        self._unproven_cycles = 0
        self.begin(0.0, 0.0)

    def begin(self, position_rad: float, torque_nm: float) -> None:
        """The joint rests here under this torque."""
        self._positions = deque([position_rad] * (2 * _HALF_CYCLES + 1), maxlen=2 * _HALF_CYCLES + 1)
        self._torques = deque([torque_nm] * _HALF_CYCLES, maxlen=_HALF_CYCLES)
        self._means = deque([torque_nm] * _HALF_CYCLES, maxlen=_HALF_CYCLES)
        self._weighted = deque([torque_nm] * (_MOST_DELAY_CYCLES + 1), maxlen=_MOST_DELAY_CYCLES + 1)
        self._steps_s: deque[float] = deque(maxlen=2 * _HALF_CYCLES)
        self._known_cycles = len(self._positions)
        self._unproven_cycles = 0
        self.proof = Proof()

    def look(self, position_rad: float, torque_nm: float, dt_s: float, heard: bool) -> Proof:
        """One cycle: where the joint is, if that was heard, and the torque that it was told last."""
        self._torques.append(torque_nm)
        self._means.append(sum(self._torques) / _HALF_CYCLES)
        self._weighted.append(sum(self._means) / _HALF_CYCLES)
        self._positions.append(position_rad)
        if not self._steps_s:
            self._steps_s.extend([dt_s] * (2 * _HALF_CYCLES))
        even = abs(dt_s - self._steps_s[-1]) <= _UNEVEN_SHARE * dt_s  # else the second difference is none
        self._steps_s.append(dt_s)
        self._known_cycles = self._known_cycles + 1 if heard and even else 0
        self._unproven_cycles += 1
        if self._known_cycles >= len(self._positions):
            self._unproven_cycles = 0
            self.proof = self._found(0.5 * sum(self._steps_s))
        elif self._unproven_cycles > _KEPT_CYCLES:
            self.proof = Proof()
        return self.proof

    def _found(self, half_s: float) -> Proof:
        begin, middle, end = self._positions[0], self._positions[_HALF_CYCLES], self._positions[-1]
        gains_rad_s2 = (end - 2.0 * middle + begin) / (half_s * half_s)
        light_nm, heavy_nm = self._least * gains_rad_s2, self._most * gains_rad_s2
        up_nm = min(self._weighted) - max(light_nm, heavy_nm)
        down_nm = -max(self._weighted) + min(light_nm, heavy_nm)
        return Proof(
            min(max(up_nm, 0.0), self._most_up_nm),
            min(max(down_nm, 0.0), self._most_down_nm),
            (end - begin) / (2.0 * half_s),
        )
