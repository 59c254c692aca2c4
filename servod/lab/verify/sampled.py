"""Linear joint, delay and velocity filter as one sampled system: what both the LMIs and the loop check stand on.

The joint is dx/dt = A x + B u + E w with x[0] the position and x[1] the velocity; the torque of cycle k acts from
t_k + delay on, held for a period; the velocity filter is the one of the encoder driver (difference over a period, exact
first-order low-pass). Everything is exact: matrix exponentials, no rounding of the delay to whole cycles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servod.formats.gains.design import Design

Array = NDArray[np.float64]
PADE, PADE_NORM = 8, 1.0
WHOLE = 1e-6  # a delay nearer than this to whole periods is whole


@dataclass(frozen=True, slots=True)
class SampledTiming:
    """Sample period, command-to-torque delay, cut-off of the velocity filter, and the torque's lag behind the delay."""

    period_s: float
    delay_s: float
    cutoff_hz: float
    lag_s: float = 0.0

    @property
    def as_delay(self) -> SampledTiming:
        """The same with the lag as delay, for who has no state for it.

        A lag tau turns the phase by atan(w*tau), a delay of tau by w*tau, which is more at every frequency: a loop that
        is designed so is designed for later torque than it has. Left out is the gain that the lag takes.
        """
        return replace(self, delay_s=self.delay_s + self.lag_s, lag_s=0.0)

    def later_by(self, delay_s: float) -> SampledTiming:
        """The same with more delay, or less; no torque comes before it is asked for."""
        return replace(self, delay_s=max(self.delay_s + delay_s, 0.0))

    @property
    def kept(self) -> float:
        """What the velocity filter keeps of its value over one period."""
        return math.exp(-2.0 * math.pi * self.cutoff_hz * self.period_s)

    @property
    def whole(self) -> int:
        """Whole periods in the delay."""
        return math.floor(self.delay_s / self.period_s + WHOLE)

    @property
    def part(self) -> float:
        """The delay's part beyond whole periods, as a share of a period."""
        part = self.delay_s / self.period_s - self.whole
        return part if part > WHOLE else 0.0

    @property
    def kept_commands(self) -> int:
        """Number of past commands that still act or wait: u_(k-1), ..., u_(k-n)."""
        return self.whole + (1 if self.part else 0)


def timing_of(design: Design) -> SampledTiming:
    """Period, delay, filter and lag that the design states."""
    model = design.model
    return SampledTiming(design.period_s, model.total_delay_s, design.velocity_cutoff_hz, model.lag_s)


def exponential(stack: Array) -> Array:
    """Matrix exponentials of a stack (..., n, n) by scaling, a diagonal Pade approximant and squaring, all at once.

    scipy's expm goes through a stack one by one, which took a third of a synthesis. Source: Higham, SIAM J. Matrix
    Anal. Appl. 26(4), 2005; the approximant of degree PADE is exact to rounding for norms up to PADE_NORM.
    """
    norm = float(np.abs(stack).sum(axis=-1).max())
    squarings = max(0, math.ceil(math.log2(norm / PADE_NORM))) if norm > 0.0 else 0
    one: Array = np.broadcast_to(np.eye(stack.shape[-1]), stack.shape)
    scaled: Array = stack / 2.0**squarings
    term: Array = one
    even, odd, factor = np.array(one), np.zeros(stack.shape), 1.0
    for j in range(1, PADE + 1):
        factor *= (PADE - j + 1) / (j * (2 * PADE - j + 1))
        term = scaled @ term
        if j % 2:
            odd += factor * term
        else:
            even += factor * term
    result = np.linalg.solve(even - odd, even + odd)
    for _ in range(squarings):
        result = np.matmul(result, result)
    return np.asarray(result, dtype=np.float64)


def with_lag(a: Array, b: Array, e: Array, lag_s: float) -> tuple[Array, Array, Array]:
    """(A, B, E) of stacks of joints whose torque follows the command by dT/dt = (u - T)/lag: one state more."""
    if lag_s <= 0.0:
        return a, b, e
    n = a.shape[-1]
    full = np.zeros((*a.shape[:-2], n + 1, n + 1))
    full[..., :n, :n], full[..., :n, n], full[..., n, n] = a, b, -1.0 / lag_s
    drive = np.zeros((*b.shape[:-1], n + 1))
    drive[..., n] = 1.0 / lag_s
    return full, drive, np.concatenate([e, np.zeros((*e.shape[:-1], 1))], axis=-1)


def sample_joint(a: Array, b: Array, e: Array, timing: SampledTiming) -> tuple[Array, Array, Array, Array]:
    """(A, B_now, B_before, E) over one period for stacks of joints: a (..., n, n), b and e (..., n).

    B_now takes u_(k-whole), B_before u_(k-whole-1), which acts until the part of the delay is over.
    """
    n = a.shape[-1]
    big = np.zeros((*a.shape[:-2], n + 2, n + 2))
    big[..., :n, :n], big[..., :n, n], big[..., :n, n + 1] = a, b, e
    over = exponential(big * timing.period_s)
    late = exponential(big * timing.period_s * (1.0 - timing.part)) if timing.part else over
    now = late[..., :n, n]
    return over[..., :n, :n], now, over[..., :n, n] - now, over[..., :n, n + 1]


def with_delay_and_filter(a: Array, b: Array, e: Array, timing: SampledTiming) -> tuple[Array, Array, Array]:
    """Sampled (A, B, E) of stacks of joints with states [joint, v_f, u_(k-1), ..., u_(k-n)], input u_k, torque w."""
    joint, now, before, force = sample_joint(a, b, e, timing)
    n, commands = a.shape[-1], timing.kept_commands
    size = n + 1 + commands
    full_a = np.zeros((*a.shape[:-2], size, size))
    full_b, full_e = np.zeros((*a.shape[:-2], size)), np.zeros((*a.shape[:-2], size))
    full_a[..., :n, :n], full_e[..., :n] = joint, force
    for column, back in ((now, timing.whole), (before, timing.whole + 1)):
        if back == 0:
            full_b[..., :n] += column
        elif back <= commands:
            full_a[..., :n, n + back] += column
    if commands:
        full_b[..., n + 1] = 1.0
    for i in range(1, commands):
        full_a[..., n + 1 + i, n + i] = 1.0
    _filter_row(full_a, full_b, full_e, n, timing)
    return full_a, full_b, full_e


def _filter_row(a: Array, b: Array, e: Array, n: int, timing: SampledTiming) -> None:
    """v_f(k+1) = kept*v_f(k) + (1 - kept)*(x(k+1) - x(k))/T, written into row n."""
    gain = (1.0 - timing.kept) / timing.period_s
    a[..., n, :], b[..., n], e[..., n] = gain * a[..., 0, :], gain * b[..., 0], gain * e[..., 0]
    a[..., n, 0] -= gain
    a[..., n, n] += timing.kept
