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
from servod.lab.verify.rounding import LEAST_COUNTS, count_rad
from servod.lab.verify.sampled import Array
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.trials import Scale, scale_of

#: The fastest sine has so many cycles to a period, and at most so many Hz; the slowest is a fortieth as fast.
CYCLES, HIGHEST_HZ, SLOWEST_SHARE = 50, 20.0, 1.0 / 40.0
FREQUENCIES = 8
#: Peak speeds as shares of the top speed: from inside Omega_L to far outside.
LEAST_SPEED, MOST_SPEED, SPEEDS = 0.006, 0.2, 6
#: Lengths at a cycle of 1 ms and less; at a slower one, whose law is slower alike, they have as many cycles.
REST_S, PUSH_AT_S, PUSH_S, BACK_S = 0.1, 0.3, 0.1, 1.0
SHORT_CYCLE_S = 0.001
WATCHED_S = 0.5  # at least, and whole periods
#: What throws it otherwise: so many periods of a sine at top speed, which end at full speed.
BEFORE_PERIODS, BEFORE_SHARE = 5, 0.25
PLANTS = 3  # drawn ones, beside the model
#: Of the stretch of a bristle at static friction, F_S/c0: in a motion that differs by more the joint slides other ways
#: than the reference.
STRETCH_SHARE = 0.5
#: Of a sine's amplitude: an error that swings by more from rest on is no tracking that a push could be compared with.
OWN_SHARE = 0.5
#: A sine of a few counts, or of less than the bristle's stretch, cannot be followed. The error of a joint that stands
#: under it is the sine itself, at most so many times as large; beyond so many times what may be left of a push one that
#: stands does not follow.
STANDS, STANDS_WITHIN = 1.05 / math.sqrt(2.0), 2.0
#: RMS of a swing over its peak to peak.
RMS_OF_SWING = 1.0 / (2.0 * math.sqrt(2.0))


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
class PushedOff:
    """One plant under a set, on sines, quiet: the noise of sensor and torque would blur what is compared."""

    gains: GainSet
    plant: AxisModel
    design: Design
    scale: Scale
    rounding_rad: float = 0.0  # peak to peak that the encoder's rounding may make of the joint

    def excesses_rad(self) -> Iterator[float]:
        """Of all sines that the drive has the torque for: how much larger the error swings BACK_S after a push, RMS."""
        friction = steady_friction(self.plant)
        spare_nm = self.scale.torque_nm / friction.gain - friction.largest(self.design.speed_max_rad_s)
        for frequency in frequencies_hz(self.design.period_s):
            for speed in speeds_rad_s(self.design):
                if 2.0 * math.pi * frequency * speed * friction.inertia <= spare_nm:
                    yield self.excess_rad(frequency, speed)

    def excess_rad(self, frequency_hz: float, speed_rad_s: float) -> float:
        """Of one sine with this peak speed; inf where the joint runs away.

        Where the error swings without any push by more than OWN_SHARE of the sine, than a joint that stands, and than
        its encoder's rounding explains, that swing itself.
        """
        period, amplitude = self.design.period_s, speed_rad_s / (2.0 * math.pi * frequency_hz)
        watched_s = math.ceil(self._s(WATCHED_S) * frequency_hz) / frequency_hz
        pushed_s = self._s(PUSH_AT_S), self._s(PUSH_AT_S + PUSH_S)
        motion = sine(amplitude, frequency_hz, pushed_s[1] + self._s(BACK_S) + watched_s, period)
        last = round(watched_s / period)
        own = self._swing_rad(motion, last)
        limit = swing_limit_rad(self.design)
        stands = min(STANDS * amplitude, STANDS_WITHIN * limit)
        if own > max(limit + RMS_OF_SWING * self.rounding_rad, OWN_SHARE * amplitude, stands):
            return own
        push = np.zeros(len(motion))
        push[round(pushed_s[0] / period) : round(pushed_s[1] / period)] = self.scale.torque_nm
        before_hz = BEFORE_SHARE * frequencies_hz(period)[-1]
        before = sine(self.scale.top_rad_s / (2.0 * math.pi * before_hz), before_hz, BEFORE_PERIODS / before_hz, period)
        moved = np.concatenate([before, motion + np.array([before[-1, 0], 0.0, 0.0])])
        return max(self._swing_rad(motion, last, push), self._swing_rad(moved, last)) - own

    def _s(self, length_s: float) -> float:
        """A length at this cycle."""
        return length_s * max(1.0, self.design.period_s / SHORT_CYCLE_S)

    def _swing_rad(self, motion: Array, last: int, push_nm: Array | None = None) -> float:
        """RMS of the error, less its mean and slope, for what creeps back is no second motion; inf if it runs away."""
        d, rest = self.design, np.zeros(round(self._s(REST_S) / self.design.period_s))
        settings = LoopSettings(d.period_s, d.counts_per_turn, d.velocity_cutoff_hz, self.scale.torque_nm)
        rows = np.concatenate([np.zeros((len(rest), 3)), motion])
        external = None if push_nm is None else np.concatenate([rest, push_nm])
        run = simulate_closed_loop(self.plant, self.gains.law, self.gains.pack(), rows, settings, external_nm=external)
        error = run.tracking_error_rad()[-last:]
        if not np.isfinite(error).all():
            return math.inf
        steps = np.arange(last, dtype=np.float64)
        return float(np.std(error - np.polyval(np.polyfit(steps, error, 1), steps)))


def swing_limit_rad(design: Design) -> float:
    """What may be left of a push [rad]: STRETCH_SHARE of F_S/c0, and LEAST_COUNTS, which no law tells from motion."""
    friction = steady_friction(design.model)
    stretch = friction.largest(LEAST_SPEED * design.speed_max_rad_s) / friction.stiffness
    return STRETCH_SHARE * stretch + LEAST_COUNTS * count_rad(design)


def check_pushes(s: Subject) -> Iterator[CertificateCheck]:
    """Sines from inside Omega_L to far outside, on model and drawn plants: each pushed, or after a faster motion."""
    scale = scale_of(s.design)
    plants = [s.design.model, *(drawn(s.design.model, s.design.uncertainty, s.seed, i) for i in range(PLANTS))]
    pushed = (PushedOff(s.gains, plant, s.design, scale, s.rounding_rad) for plant in plants)
    found = (excess for each in pushed for excess in each.excesses_rad())
    worst = max(found, default=math.inf)  # a drive that has the torque for no sine proves nothing
    yield at_most("pushed off a sine, error that swings on [rad RMS]", worst, swing_limit_rad(s.design))
