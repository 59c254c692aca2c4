"""Motions as plain functions of time: the paper's trajectory (19), sine, table. SI units, no I/O.

Under the loop's references and under every simulation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

#: The paper's trajectory (19): (A - B t) sin(w t)
PAPER_AMPLITUDE_RAD = 0.1


PAPER_DECAY_RAD_PER_S = 0.0033


PAPER_OMEGA_RAD_PER_S = 0.2 * math.pi

#: When the envelope A - B t of (19) has come to nothing, s.
PAPER_LONGEST_S = PAPER_AMPLITUDE_RAD / PAPER_DECAY_RAD_PER_S

Sample = tuple[float, float, float]


class Samples(Protocol):
    """Positions that a table motion reads: a list, an array or the shared trajectory area."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> float: ...


def paper(t_s: float) -> Sample:
    """Trajectory (19) of the paper, x = (0.1 - 0.0033 t) sin(0.2 pi t) rad, and its derivatives."""
    w, envelope = PAPER_OMEGA_RAD_PER_S, PAPER_AMPLITUDE_RAD - PAPER_DECAY_RAD_PER_S * t_s
    sin, cos = math.sin(w * t_s), math.cos(w * t_s)
    return (
        envelope * sin,
        envelope * w * cos - PAPER_DECAY_RAD_PER_S * sin,
        -envelope * w * w * sin - 2.0 * PAPER_DECAY_RAD_PER_S * w * cos,
    )


def sine(amplitude_rad: float, frequency_hz: float) -> Callable[[float], Sample]:
    """A sine of position."""
    w = 2.0 * math.pi * frequency_hz

    def path(t_s: float) -> Sample:
        sin, cos = math.sin(w * t_s), math.cos(w * t_s)
        return amplitude_rad * sin, amplitude_rad * w * cos, -amplitude_rad * w * w * sin

    return path


def table(positions_rad: Samples, samples: int, period_s: float) -> Callable[[float], Sample]:
    """The first `samples` positions, one period apart, linear between them, with the velocity of the interval.

    Relative to the first of them, so that no table makes the reference jump when it starts.
    """
    last, first_rad = samples - 1, positions_rad[0]

    def path(t_s: float) -> Sample:
        index = min(int(t_s / period_s + 1e-9), last - 1)
        here, there = positions_rad[index], positions_rad[index + 1]
        velocity = (there - here) / period_s
        return here - first_rad + velocity * (t_s - index * period_s), velocity, 0.0

    return path


def torque_table(samples: Samples, start: int, count: int, period_s: float) -> Callable[[float], float]:
    """`count` torques from `samples[start]` on, each held for one period; zero behind the last."""

    def torque(t_s: float) -> float:
        index = int(t_s / period_s + 1e-9)
        return samples[start + index] if index < count else 0.0

    return torque
