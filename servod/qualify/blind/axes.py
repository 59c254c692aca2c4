"""Axes of the trial: three kinds of joints, drawn in sizes over three decades.

Stands between physics and what is concealed. Every axis is a kind scaled: torques, travel and tempo by a factor each,
and its parameters spread a little one by one, so that no two are alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from servod.qualify.blind.physics import Physics
from servod.qualify.blind.plant import PERIOD_S, Loop

# --- The motions -----------------------------------------------------------------------------------------------------
# What the axes of the trial do in front of the recorder: four references, rows of a millisecond. The three recordings
# of a case have a reason each: the slow sine shows friction and everything over position, the multisine inertia, delay
# and elasticity, the moves breakaway and rest; the fourth is held out.


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
        made, now, position = np.zeros(len(t)), 0.3, 0.0
        while now < seconds:
            goal = self.travel * rng.uniform(-1.0, 1.0)
            far = abs(goal - position) / self.travel
            lasts = (0.12 + 0.35 * math.sqrt(far)) * rng.uniform(0.8, 2.5) / self.tempo
            made += (goal - position) * quintic((t - now) / lasts)
            now += lasts + rng.choice([0.05, 0.4, 0.9]) * rng.uniform(0.5, 1.5)
            position = goal
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


Rng = np.random.Generator


class CaseKind(StrEnum):
    """Kinds of joints."""

    LAB_JOINT = "lab_joint"
    HARMONIC_DRIVE = "harmonic_drive"
    DIRECT_DRIVE = "direct_drive"


@dataclass(frozen=True)
class CaseAxis:
    """An axis with nothing concealed: physics, controller, motions, and the scales that effects are drawn by.

    `speed` is what its motions reach (rad/s), `effort` the torque that its controller asks for then (N*m).
    """

    kind: CaseKind
    physics: Physics
    loop: Loop
    motions: Motions

    @property
    def speed(self) -> float:
        """Speed of the faster motions, rad/s."""
        return 2.0 * math.pi * 0.72 * self.motions.travel * self.motions.tempo

    @property
    def effort(self) -> float:
        """Torque of the faster motions, N*m."""
        p = self.physics
        return p.coulomb + p.viscous * self.speed + p.inertia * 8.0 * self.motions.tempo * self.speed + p.gravity

    def with_travel(self, least: float) -> CaseAxis:
        """The axis with at least so much travel (rad), at the same speed."""
        if self.motions.travel >= least:
            return self
        slower = self.motions.tempo * math.sqrt(self.motions.travel / least)
        return replace(self, motions=Motions(least, slower))


_KINDS = {
    CaseKind.LAB_JOINT: (
        Physics(0.001, coulomb=0.045, static=0.07, viscous=0.056, stribeck_velocity=0.1, sigma0=950.0, sigma1=1.0),
        Loop(2.5, 0.05, 12.0, 1.0, 2.0**17),
        Motions(0.6, 1.0),
    ),
    CaseKind.HARMONIC_DRIVE: (
        Physics(0.8, coulomb=6.0, static=8.0, viscous=9.0, stribeck_velocity=0.08, sigma0=9000.0, sigma1=60.0),
        Loop(900.0, 45.0, 3500.0, 120.0, 2.0**19),
        Motions(1.0, 1.0),
    ),
    CaseKind.DIRECT_DRIVE: (
        Physics(0.02, coulomb=0.12, static=0.15, viscous=0.02, stribeck_velocity=0.05, sigma0=400.0, sigma1=1.5),
        Loop(36.0, 1.45, 180.0, 8.0, 2.0**20),
        Motions(1.5, 1.0),
    ),
}

#: Decades of torque to both sides of the three kinds, which themselves span two.
DECADES = 0.6

#: Heating of an axis in front of the recorder, degC in the first 16 s.
HEATS_C = 6.0


def draw_axis(rng: Rng, kind: CaseKind, weight: bool) -> CaseAxis:
    """An axis of a kind; with `weight`, a known weight hangs on it."""
    physics, loop, motions = _KINDS[kind]
    torque = 10.0 ** rng.uniform(-DECADES, DECADES)
    spread = {key: float(rng.uniform(0.8, 1.25)) for key in ("inertia", "viscous", "coulomb", "sigma0", "sigma1")}
    changed = {key: getattr(physics, key) * torque * factor for key, factor in spread.items()}
    excess = float(rng.choice([0.0, 1.0])) * (physics.static / physics.coulomb - 1.0) * rng.uniform(0.6, 1.2)
    axis = CaseAxis(
        kind,
        physics._replace(
            **changed,
            static=changed["coulomb"] * (1.0 + excess),
            stribeck_velocity=physics.stribeck_velocity * float(rng.uniform(0.8, 1.25)),
        ),
        loop._replace(kp=loop.kp * torque, kd=loop.kd * torque, ki=loop.ki * torque, limit=loop.limit * torque),
        Motions(motions.travel * float(rng.uniform(0.85, 1.2)), float(rng.uniform(0.85, 1.15))),
    )
    if weight:
        hung = changed["coulomb"] * float(rng.uniform(1.2, 2.2))
        axis = replace(axis, physics=axis.physics._replace(gravity=hung, gravity_phase=float(rng.uniform(0.0, 6.28))))
    return replace(axis, physics=axis.physics._replace(heating=_heating(axis)))


def _heating(axis: CaseAxis) -> float:
    """Warming per joule that makes HEATS_C of the losses of 16 s of slow motion."""
    p, speed = axis.physics, axis.motions.travel * axis.motions.tempo
    loss_j = 16.0 * (0.8 * p.coulomb + 0.6 * p.viscous * speed) * 1.1 * speed
    return HEATS_C / loss_j
