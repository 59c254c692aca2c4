"""Time functions that experiments are made of: ramps, bursts, multisines, sines of position, triangles.

Under the experiments; plain arrays, one value for each period of the loop.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def samples(duration_s: float, period_s: float) -> int:
    """Periods in a duration, at least two."""
    return max(2, round(duration_s / period_s))


def times(duration_s: float, period_s: float) -> Array:
    """Time of each sample."""
    stamps: Array = np.asarray(np.arange(samples(duration_s, period_s)) * period_s, dtype=np.float64)
    return stamps


def fade_in(t_s: Array, over_s: float) -> Array:
    """A raised cosine from 0 to 1 in `over_s`."""
    rise: Array = np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(t_s / over_s, 0.0, 1.0)), dtype=np.float64)
    return rise


def growing(first: float, last: float, duration_s: float, period_s: float) -> Array:
    """An exponential from `first` to `last`: the same relative rate at every scale."""
    t = times(duration_s, period_s)
    grown: Array = np.asarray(first * (last / first) ** (t / t[-1]), dtype=np.float64)
    return grown


def multisine(lines: NDArray[np.int64], weights: Array, count: int, rng: np.random.Generator) -> Array:
    """One period of `count` samples: sines at whole `lines` per period, of the best of some random phases.

    `weights` are the lines' amplitudes; the phases with the lowest peak are kept (crest factor).
    """
    angle = 2.0 * np.pi * np.outer(lines, np.arange(count)) / count
    best: Array = np.zeros(count)
    lowest = math.inf
    for _ in range(40):
        phases = rng.uniform(0.0, 2.0 * np.pi, len(lines))
        wave: Array = weights @ np.sin(angle + phases[:, None])
        peak = float(np.max(np.abs(wave)))
        if peak < lowest:
            lowest, best = peak, wave
    return best


def sine(amplitude_rad: float, peak_rad_s: float, turns: float, period_s: float) -> tuple[Array, Array]:
    """A sine of position from one end of it, at rest, through `turns` periods: (position from there, velocity)."""
    omega = peak_rad_s / amplitude_rad
    t = times(turns * 2.0 * np.pi / omega, period_s)
    path: Array = amplitude_rad * (1.0 - np.cos(omega * t))
    velocity: Array = peak_rad_s * np.sin(omega * t)
    return path, velocity


def strokes(speed_rad_s: float, steady_s: float, turn_s: float, count: int, period_s: float) -> tuple[Array, list[int]]:
    """There and back at constant speed, `count` strokes; returns positions and the first steady sample of each.

    Velocity changes sign over `turn_s` along a cosine; the path is centred on zero.
    """
    half_turn, steady = samples(0.5 * turn_s, period_s), samples(steady_s, period_s)
    rise = np.sin(0.5 * np.pi * (np.arange(half_turn) + 0.5) / half_turn)
    stroke = np.concatenate([rise, np.ones(steady), rise[::-1]])
    velocity = np.concatenate([stroke * (1.0 if i % 2 == 0 else -1.0) for i in range(count)])
    path: Array = np.cumsum(velocity) * speed_rad_s * period_s
    starts = [i * len(stroke) + half_turn for i in range(count)]
    return path, starts
