"""Position, velocity and acceleration from a recorded position: local cubics whose span fits the motion.

Stands before replay, identification and diagnosis. Smooth motion deserves a long span (noise), an impact or a
breakaway a short one (bias); the span is chosen for each row by Lepski's rule.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Rows that a local cubic spans, shortest first.
SPANS: tuple[int, ...] = (5, 7, 11, 15, 21, 31, 45)

#: Standard errors by which a longer span may leave a shorter one.
AGREE = 2.0


def smoothed_motion(t_s: Array, position: Array) -> Array:
    """Rows of position, velocity, acceleration at the rows' own times; uneven rows go over an even grid.

    Lepski's rule: from the shortest span upward, the longest one whose position and velocity agree with all shorter
    ones within their standard errors (Lepski, Theory Probab. Appl. 35, 1990).
    """
    period = float(np.median(np.diff(t_s)))
    even = t_s[0] + period * np.arange(round((t_s[-1] - t_s[0]) / period) + 1)
    on_grid = np.interp(even, t_s, position)
    spans = [span for span in SPANS if span <= len(even)]
    if not spans:
        return np.column_stack([position, np.gradient(position, t_s), np.zeros_like(position)])
    chosen = _lepski(on_grid, period, spans, noise_rms(position))
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
    """Position, velocity, acceleration with the span chosen for each row."""
    from scipy.signal import savgol_coeffs, savgol_filter

    chosen = [savgol_filter(position, spans[0], 3, deriv=d, delta=period) for d in range(3)]
    low, high = np.full((2, len(position)), -np.inf), np.full((2, len(position)), np.inf)
    alive = np.ones(len(position), dtype=bool)
    for span in spans:
        parts = [savgol_filter(position, span, 3, deriv=d, delta=period) for d in range(3)]
        for order in range(2):
            gain = float(np.linalg.norm(savgol_coeffs(span, 3, deriv=order, delta=period)))
            low[order] = np.maximum(low[order], parts[order] - AGREE * noise * gain)
            high[order] = np.minimum(high[order], parts[order] + AGREE * noise * gain)
            alive &= low[order] <= high[order]
        chosen = [np.where(alive, part, kept) for part, kept in zip(parts, chosen, strict=True)]
    return chosen
