"""A servo that swings a pendulum, written down again: what recordings of a goal and a position are tested on.

Knows nothing of servod's kernels: plain Euler steps of 20 us, a firmware loop of 1 kHz that reads a counting encoder,
goals that arrive late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEP_S = 2e-5


@dataclass(frozen=True)
class ServoAxis:
    """The truth, SI: duty = clip(gain*error + ki*integral(error) - kd*speed, +-1), torque = full*duty - emf*speed.

    error = goal(t - delay) - position, nothing within the dead band; the goal moves no faster than its rate. Dry
    friction grows by `per_torque` of that torque; a drive that is off makes none.
    """

    gain: float = 6.0
    full: float = 3.0
    delay_s: float = 0.02
    inertia: float = 0.03
    viscous: float = 0.5
    coulomb: float = 0.06
    gravity: float = 0.8
    kd: float = 0.0
    counts: float = 4096.0
    off_from_s: float = math.inf
    goal_rate: float = math.inf
    dead_band: float = 0.0
    ki: float = 0.0
    emf: float = 0.0
    per_torque: float = 0.0

    def run(self, goal: Array, period_s: float) -> Array:
        """Positions as its encoder shows them when each row is sent, from rest at 0."""
        shown = np.zeros(len(goal))
        x = v = duty = total = 0.0
        aim, on = float(goal[0]), True
        per_row, per_loop = round(period_s / STEP_S), round(1e-3 / STEP_S)
        for step in range(len(goal) * per_row):
            if step % per_row == 0:
                shown[step // per_row] = self._count(x)
            if step % per_loop == 0:
                row = math.floor((step * STEP_S - self.delay_s) / period_s + 1e-9)
                way = goal[max(row, 0)] - aim
                aim += math.copysign(min(abs(way), self.goal_rate * 1e-3), way)
                error = aim - self._count(x)
                error = 0.0 if abs(error) <= self.dead_band else error
                duty = min(max(self.gain * error + total - self.kd * v, -1.0), 1.0)
                total = min(max(total + self.ki * error * 1e-3, -1.0), 1.0)
                on = step * STEP_S < self.off_from_s
            made = self.full * duty - self.emf * v if on else 0.0
            push = made - self.gravity * math.sin(x) - self.viscous * v
            dry = self.coulomb + self.per_torque * abs(made)
            if v == 0.0 and abs(push) <= dry:
                continue
            grip = math.copysign(dry, v if v != 0.0 else push)
            new = v + STEP_S * (push - grip) / self.inertia
            v = 0.0 if v != 0.0 and new * v < 0.0 else new
            x += STEP_S * v
        return shown

    def _count(self, x: float) -> float:
        return round(x * self.counts / (2.0 * math.pi)) * 2.0 * math.pi / self.counts


def goal_of(t_s: Array, kind: int) -> Array:
    """Three motions: two sines, a sweep, and moves with rests."""
    if kind == 0:
        return np.asarray(0.8 * np.sin(2.2 * t_s) + 0.35 * np.sin(7.1 * t_s))
    if kind == 1:
        return np.asarray(0.9 * np.sin(1.1 * t_s**1.5))
    corners = np.array([0.0, 0.9, 0.9, -0.7, -0.7, 0.4, 1.3, 1.3, 0.0])
    return np.interp(t_s, np.linspace(0.0, float(t_s[-1]), len(corners)), corners)
