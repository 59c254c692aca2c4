"""Position, velocity and acceleration from a recorded position: local cubics whose span fits the motion.

Stands before replay, identification and diagnosis. Smooth motion deserves a long span (noise), an impact or a
breakaway a short one (bias); the span is chosen for each row by Lepski's rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
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


# --- How a recording starts ------------------------------------------------------------------------------------------
# How a recording starts: at rest or in motion, and under which command; judged from its first rows alone. The first row
# is the poorest of all (nothing before it), and a free run carries its error to the end; so what is known of rests
# counts more there than the slope of a few samples.


#: An axis whose motion, extrapolated backward, began at most so long before the first row was just set off, s.
MOTION_BEGAN_S = 0.01

#: ... or so many rows, for windows that start from what was recorded: the smoothing errs by no more.
MOTION_BEGAN_ROWS = 2.0

#: ... provided that its command began at most so long before: mid-motion, friction keeps the command up all the time.
COMMAND_BEGAN_S = 0.05

#: Within this time an axis leaves its rest when the first recorded command is new to it, s.
LEAVES_S = 0.05

#: For so long before the first row, at most, the command is taken to have changed as it then goes on to, s.
TREND_HOLDS_S = 0.05

#: Standard deviations of the position's noise that make a motion, and the growth of the command that could cause it.
LEFT, GROWN = 5.0, 1.05

#: Rows that a parabola through the first rows needs.
LEAST_ROWS = 5


class Start(StrEnum):
    """Where a replay takes its first velocity from."""

    AUTO = "auto"  # rest where the first rows say so, else as recorded
    REST = "rest"
    RECORDED = "recorded"


@dataclass(frozen=True, slots=True)
class FirstRow:
    """Motion (position, velocity, acceleration) at the first row, and the command before it; SI units of the axis.

    `command_before` acts until the first recorded one arrives.
    """

    motion: tuple[float, float, float]
    command_before: float
    at_rest: bool


@dataclass(frozen=True, slots=True)
class Beginning:
    """What the first rows say of how a motion begins, whenever commands act: `under` a delay it is a `FirstRow`.

    `growth` is that of the command, 1/s of its unit; `left_s` the time at which an axis that stood had left, if it did.
    """

    motion: tuple[float, float, float]
    at_rest: bool
    stood: bool
    growth: float
    left_s: float | None
    t_s: Array
    torque: Array

    def under(self, delay_s: float) -> FirstRow:
        """The first row where a command acts `delay_s` after its row."""
        command = float(self.torque[0])
        if not self.stood:
            before = command - self.growth * min(0.5 * delay_s, TREND_HOLDS_S)
        else:
            before = 0.0 if self._is_new(delay_s) else command
        return FirstRow(self.motion, before, self.at_rest)

    def _is_new(self, delay_s: float) -> bool:
        """Whether an axis that stands at the first row leaves though the command does not grow: it was not under it
        before.

        An axis that rests under the first row's command stays where it is, until the command grows.
        """
        if self.left_s is None:
            return False
        acted = max(1, int(np.searchsorted(self.t_s, self.left_s - delay_s, side="right")))
        return bool(np.max(np.abs(self.torque[:acted])) <= GROWN * abs(self.torque[0]))


def beginning(
    start: Start, t_s: Array, torque: Array, position: Array, motion: Array, *, free: bool = True
) -> Beginning:
    """How the motion begins; `motion` has the rows of `smoothed_motion`.

    AUTO is rest when the first row's speed is within its error of zero, or when the axis was just set off: motion and
    command both extrapolate to nothing within MOTION_BEGAN_S and COMMAND_BEGAN_S before the first row. People start
    recorder and motion together; the recorder's first rows then lag the start, and such a recording is understood as
    one from rest (EMPS: 7 and 45 ms) where the model runs on freely from there (`free`); the first of many windows
    starts as recorded unless its motion began with its first rows. A recording cut out of a motion keeps its speed.
    """
    place, speed, acceleration = (float(value) for value in motion[0, :3])
    still = stands(t_s, position, motion)
    within_s = MOTION_BEGAN_S if free else MOTION_BEGAN_ROWS * float(t_s[1] - t_s[0])
    begun = still or just_set_off(t_s, torque, position, within_s)
    rest = start is Start.REST or (start is Start.AUTO and begun)
    if still and rest:
        acceleration = 0.0
    moved = place, 0.0 if rest else speed, acceleration
    growth, left_s = (0.0, leaves(t_s, position)) if still else (trend(t_s, torque), None)
    return Beginning(moved, rest, still, growth, left_s, t_s, torque)


def stands(t_s: Array, position: Array, motion: Array) -> bool:
    """Whether the first row's speed is within two standard errors of zero.

    Where smoothing is no surer than the first difference (an axis that breaks away leaves only short spans), the first
    difference counts as well: it alone is free of what comes later.
    """
    if abs(motion[0, 1]) <= AGREE * motion[0, 3]:
        return True
    step_error = np.sqrt(2.0) * noise_rms(position)
    poor = step_error <= motion[0, 3] * (t_s[1] - t_s[0])
    return bool(poor and abs(position[1] - position[0]) <= AGREE * step_error)


def first_rows(t_s: Array) -> int:
    """Number of rows of the first MOTION_BEGAN_S, LEAST_ROWS at least."""
    return max(LEAST_ROWS, int(np.searchsorted(t_s, t_s[0] + MOTION_BEGAN_S, side="right")))


def trend(t_s: Array, torque: Array) -> float:
    """Growth of the command over the first rows, 1/s of its unit."""
    since = t_s[: first_rows(t_s)] - t_s[0]
    return float(np.polyfit(since, torque[: len(since)], 1)[0]) if len(np.unique(since)) >= LEAST_ROWS else 0.0


def just_set_off(t_s: Array, torque: Array, position: Array, within_s: float = MOTION_BEGAN_S) -> bool:
    """Whether both motion and command, extrapolated backward, began only just (`within_s`) before the first row."""
    rows = first_rows(t_s)
    since = t_s[:rows] - t_s[0]
    if len(np.unique(since)) < LEAST_ROWS:
        return False
    bend, speed, _ = np.polyfit(since, position[:rows], 2)
    growth, command = np.polyfit(since, torque[:rows], 1)
    moves_on = speed * bend > 0.0 and abs(speed) <= within_s * abs(2.0 * bend)
    grows = command * growth > 0.0 and abs(command) <= COMMAND_BEGAN_S * abs(growth)
    return bool(moves_on and grows and command * speed > 0.0)


def leaves(t_s: Array, position: Array) -> float | None:
    """When an axis that stands at the first row has left it, within LEAVES_S; None where it does not."""
    early = int(np.searchsorted(t_s, t_s[0] + LEAVES_S, side="right"))
    away = np.flatnonzero(np.abs(position[:early] - position[0]) > LEFT * noise_rms(position))
    return float(t_s[away[0]]) if len(away) else None
