"""Position, velocity and acceleration from a recorded position: local cubics whose span fits the motion.

Stands before replay, identification and diagnosis. Smooth motion deserves a long span (noise), an impact or a
breakaway a short one (bias); the span is chosen for each row by Lepski's rule.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Rows that a local cubic spans, shortest first.
SPANS: tuple[int, ...] = (5, 7, 11, 15, 21, 31, 45)

#: Standard errors by which a longer span may leave a shorter one.
AGREE = 2.0


def smoothed_motion(t_s: Array, position: Array) -> Array:
    """Rows of position, velocity, acceleration and the velocity's standard error, at the rows' own times.

    Uneven rows go over an even grid. Lepski's rule: from the shortest span upward, the longest one whose position and
    velocity agree with all shorter ones within their standard errors (Lepski, Theory Probab. Appl. 35, 1990).
    """
    period = float(np.median(np.diff(t_s)))
    even = t_s[0] + period * np.arange(round((t_s[-1] - t_s[0]) / period) + 1)
    on_grid = np.interp(even, t_s, position)
    spans = [span for span in SPANS if span <= len(even)]
    noise = noise_rms(position)
    if not spans:
        nothing = np.zeros_like(position)
        return np.column_stack([position, np.gradient(position, t_s), nothing, nothing + noise / period])
    chosen = _lepski(on_grid, period, spans, noise)
    return np.column_stack([np.interp(t_s, even, part) for part in chosen])


def noise_rms(position: Array) -> float:
    """Noise of a position record: the encoder's step over sqrt(12), or what fourth differences show if that is more.

    Motion hardly enters a fourth difference; white noise of RMS s gives it sqrt(70)*s.
    """
    steps = np.abs(np.diff(position))
    quantum = float(steps[steps > 0.0].min()) if np.any(steps > 0.0) else 0.0
    fourth = np.abs(np.diff(position, 4))
    spread = float(np.median(fourth)) / (0.6745 * np.sqrt(70.0)) if len(fourth) else 0.0
    return float(max(quantum / np.sqrt(12.0), spread))


def _lepski(position: Array, period: float, spans: list[int], noise: float) -> list[Array]:
    """Position, velocity, acceleration and the velocity's standard error, with the span chosen for each row."""
    from scipy.signal import savgol_filter

    rows = len(position)
    low, high = np.full((2, rows), -np.inf), np.full((2, rows), np.inf)
    alive = np.ones(rows, dtype=bool)
    chosen: list[Array] = []
    for span in spans:
        parts = [savgol_filter(position, span, 3, deriv=d, delta=period) for d in range(3)]
        errors = [noise * _gains(span, order, rows) / period**order for order in range(2)]
        for order in range(2):
            low[order] = np.maximum(low[order], parts[order] - AGREE * errors[order])
            high[order] = np.minimum(high[order], parts[order] + AGREE * errors[order])
            alive &= low[order] <= high[order]
        parts.append(errors[1])
        chosen = [np.where(alive, part, kept) for part, kept in zip(parts, chosen or parts, strict=True)]
    return chosen


def _gains(span: int, order: int, rows: int) -> Array:
    """Standard error of a local cubic's value (order 0) or slope per row, for noise of 1; one-sided at both ends."""
    inside, start = _gain_table(span, order)
    gains = np.full(rows, inside)
    gains[: len(start)] = start
    gains[rows - len(start) :] = start[::-1]
    return gains


@cache
def _gain_table(span: int, order: int) -> tuple[float, tuple[float, ...]]:
    """Gain inside the record, and of the first half span from the very first row on."""
    from scipy.signal import savgol_coeffs

    gains = [float(np.linalg.norm(savgol_coeffs(span, 3, deriv=order, pos=place))) for place in range(span // 2 + 1)]
    return gains[-1], tuple(gains[:-1])
