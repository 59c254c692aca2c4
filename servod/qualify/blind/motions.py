"""What the axes of the trial do in front of the recorder: four references, rows of a millisecond.

Stands beside the plant. The three recordings of a case have a reason each: the slow sine shows friction and everything
over position, the multisine inertia, delay and elasticity, the moves breakaway and rest; the fourth is held out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.qualify.blind.plant import PERIOD_S

Array = NDArray[np.float64]

#: Components of the multisine, Hz at tempo 1.
TONES_HZ = (0.21, 0.36, 0.93, 1.71, 2.5, 3.14, 3.86, 5.29)

#: Time in which a motion grows from rest, s.
GROWS_S = 0.4


@dataclass(frozen=True)
class Motions:
    """How far (rad, from the middle) and how fast (1 = the practice's) an axis is moved."""

    travel: float
    tempo: float

    def slow_sine(self, rng: np.random.Generator, seconds: float = 16.0) -> Array:
        """Back and forth over the whole range."""
        t = times(seconds)
        frequency = self.tempo * rng.uniform(0.22, 0.32)
        return grown(t, self.travel * np.sin(2.0 * math.pi * frequency * t))

    def multisine(self, rng: np.random.Generator, seconds: float = 14.0) -> Array:
        """Eight tones of falling amplitude."""
        t = times(seconds)
        tones = [self.tempo * f * rng.uniform(0.95, 1.05) for f in TONES_HZ]
        made = sum(np.sin(2.0 * math.pi * f * t + rng.uniform(0.0, 6.28)) / (1.0 + f / tones[0]) ** 0.8 for f in tones)
        whole = np.asarray(made) - float(np.asarray(made)[0])
        return grown(t, 0.72 * self.travel * whole / float(np.max(np.abs(whole))))

    def moves(self, rng: np.random.Generator, seconds: float = 16.0) -> Array:
        """From place to place in short and long moves, with rests."""
        t = times(seconds)
        made, now, place = np.zeros(len(t)), 0.3, 0.0
        while now < seconds:
            goal = self.travel * rng.uniform(-1.0, 1.0)
            far = abs(goal - place) / self.travel
            lasts = (0.12 + 0.35 * math.sqrt(far)) * rng.uniform(0.8, 2.5) / self.tempo
            made += (goal - place) * quintic((t - now) / lasts)
            now += lasts + rng.choice([0.05, 0.4, 0.9]) * rng.uniform(0.5, 1.5)
            place = goal
        return made

    def mixed(self, rng: np.random.Generator, seconds: float = 12.0) -> Array:
        """Two sines of other frequencies, the larger one swelling: the hold-out."""
        t = times(seconds)
        slow, fast = self.tempo * rng.uniform(0.3, 0.5), self.tempo * rng.uniform(1.1, 1.9)
        swell = 0.75 + 0.25 * np.cos(2.0 * math.pi * t / seconds)
        made = 0.72 * swell * np.sin(2.0 * math.pi * slow * t) + 0.23 * np.sin(2.0 * math.pi * fast * t)
        return grown(t, self.travel * made)


def times(seconds: float) -> Array:
    """Rows of time, s."""
    return PERIOD_S * np.arange(round(seconds / PERIOD_S) + 1, dtype=np.float64)


def quintic(share: Array) -> Array:
    """0 before 0, 1 after 1, in between without a jump of acceleration."""
    s = np.clip(share, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s * s))


def grown(t: Array, motion: Array) -> Array:
    """`motion` that starts from rest."""
    return np.asarray(motion * quintic(t / GROWS_S))
