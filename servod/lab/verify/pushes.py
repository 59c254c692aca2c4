"""Whether a joint that something threw off a sine comes back to it, or swings on for ever in another steady motion.

Stands on the compiled simulator, beside `trials`. Friction that is compensated with the phase of the reference, regions
by speed and an observer that gathers while a joint sticks leave room for a second steady motion under one and the same
reference, as in jump resonance. No pole shows it, nor does a trial that begins at rest: it wants a push.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import CertificateCheck, GainSet
from servod.formats.model.axis_model import AxisModel
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.verify.checks import Subject, at_most
from servod.lab.verify.plants import drawn
from servod.lab.verify.sampled import Array
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.trials import Scale, scale_of

#: The fastest sine has so many cycles to a period, and at most so many Hz; the slowest is a fortieth as fast.
CYCLES, HIGHEST_HZ, SLOWEST_SHARE = 50, 20.0, 1.0 / 40.0
FREQUENCIES = 8
#: Peak speeds as shares of the top speed: from inside Omega_L to far outside.
LEAST_SPEED, MOST_SPEED, SPEEDS = 0.006, 0.2, 6
REST_S, PUSH_AT_S, PUSH_S, BACK_S = 0.1, 0.3, 0.1, 1.0
WATCHED_S = 0.5  # at least, and whole periods
#: What throws it otherwise: a sine at top speed that ends in mid-swing, at so much of the highest frequency.
BEFORE_S, BEFORE_SHARE = 1.0, 0.25
PLANTS = 3  # drawn ones, beside the model
#: Of the stretch of a bristle at full friction, F_max/c0: in a motion that differs by more the joint slides other ways
#: than the reference.
STRETCH_SHARE = 0.5


def frequencies_hz(period_s: float) -> list[float]:
    """Of the sines, lowest first."""
    highest = min(HIGHEST_HZ, 1.0 / (CYCLES * period_s))
    return [float(f) for f in np.geomspace(SLOWEST_SHARE * highest, highest, FREQUENCIES)]


def speeds_rad_s(design: Design) -> list[float]:
    """Peak speeds of the sines, lowest first."""
    return [float(v) for v in design.speed_max_rad_s * np.geomspace(LEAST_SPEED, MOST_SPEED, SPEEDS)]


def sine(amplitude_rad: float, frequency_hz: float, duration_s: float, period_s: float) -> Array:
    """Rows of position, velocity and acceleration."""
    w, t = 2.0 * math.pi * frequency_hz, period_s * np.arange(1, round(duration_s / period_s) + 1)
    rows = np.stack([np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t)], axis=1)
    return amplitude_rad * rows


@dataclass(frozen=True)
class Thrown:
    """One plant under a set, on sines, quiet: the noise of sensor and torque would blur what is compared."""

    gains: GainSet
    plant: AxisModel
    design: Design
    scale: Scale

    def excesses_rad(self) -> Iterator[float]:
        """Of all sines: how much larger the error swings BACK_S after a push than without one, RMS [rad]."""
        for frequency in frequencies_hz(self.design.period_s):
            yield from (self.excess_rad(frequency, speed) for speed in speeds_rad_s(self.design))

    def excess_rad(self, frequency_hz: float, speed_rad_s: float) -> float:
        """Of one sine with this peak speed; inf where the joint runs away."""
        period, amplitude = self.design.period_s, speed_rad_s / (2.0 * math.pi * frequency_hz)
        watched_s = math.ceil(WATCHED_S * frequency_hz) / frequency_hz
        motion = sine(amplitude, frequency_hz, PUSH_AT_S + PUSH_S + BACK_S + watched_s, period)
        push = np.zeros(len(motion))
        push[round(PUSH_AT_S / period) : round((PUSH_AT_S + PUSH_S) / period)] = self.scale.torque_nm
        before_hz = BEFORE_SHARE * frequencies_hz(period)[-1]
        before = sine(self.scale.top_rad_s / (2.0 * math.pi * before_hz), before_hz, BEFORE_S, period)
        moved = np.concatenate([before, motion + np.array([before[-1, 0], 0.0, 0.0])])
        last = round(watched_s / period)
        thrown = max(self._swing_rad(motion, last, push), self._swing_rad(moved, last))
        return thrown - self._swing_rad(motion, last)

    def _swing_rad(self, motion: Array, last: int, push_nm: Array | None = None) -> float:
        """Standard deviation of the error: without its mean, for what creeps back is no second motion."""
        d, rest = self.design, np.zeros(round(REST_S / self.design.period_s))
        settings = LoopSettings(d.period_s, d.counts_per_turn, d.velocity_cutoff_hz, self.scale.torque_nm)
        rows = np.concatenate([np.zeros((len(rest), 3)), motion])
        external = None if push_nm is None else np.concatenate([rest, push_nm])
        run = simulate_closed_loop(self.plant, self.gains.law, self.gains.pack(), rows, settings, external_nm=external)
        error = run.tracking_error_rad()[-last:]
        return float(np.std(error)) if np.isfinite(error).all() else math.inf


def swing_limit_rad(design: Design) -> float:
    """What may be left of a push: STRETCH_SHARE of F_max/c0 [rad]."""
    friction = steady_friction(design.model)
    return STRETCH_SHARE * friction.largest(design.speed_max_rad_s) / friction.stiffness


def check_pushes(s: Subject) -> Iterator[CertificateCheck]:
    """Sines from inside Omega_L to far outside, on model and drawn plants: each pushed, or after a faster motion."""
    scale = scale_of(s.design)
    plants = [s.design.model, *(drawn(s.design.model, s.design.uncertainty, s.seed, i) for i in range(PLANTS))]
    worst = max(excess for plant in plants for excess in Thrown(s.gains, plant, s.design, scale).excesses_rad())
    yield at_most("pushed off a sine, error that swings on [rad RMS]", worst, swing_limit_rad(s.design))
