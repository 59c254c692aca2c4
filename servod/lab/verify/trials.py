"""Motions that a set must stand on simulated plants: Monte-Carlo over the intervals, long holds, slow ramps.

Stands on the compiled simulator. Runs in worker processes, so everything here is a plain function on plain values.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servod.common.workers import worker_pool
from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.effects import Noise
from servod.lab.simulate.noise import noise_of, noise_series
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.verify.plants import drawn
from servod.lab.verify.sampled import Array
from servod.lab.verify.steady_friction import steady_friction

#: Steps in seconds of travel at the top speed, 10 and 100 mrad at 0.5 rad/s: one that the joint answers on its bristle,
#: and one that it must travel for.
SMALL_STEP_S, LARGE_STEP_S = 0.02, 0.2
SINE_HZ = 0.25
#: Peak speed of the sine: past the fall of the Stribeck curve, and no less than this share of the top speed.
PAST_FALL, LEAST_PEAK = 1.3, 0.16
LEAD_IN_S, STEP_S, SINE_S, HOLD_S, LARGE_S = 0.1, 0.6, 4.0, 1.0, 1.0
ERROR_SHARE = 0.04  # of the sine's amplitude: a plant beyond it does not follow
RIPPLE_LIMIT_RAD = 1e-4  # peak to peak of a long hold, torque noise included
#: Of the large step, peak to peak from 0.8 s after a motion on, beyond what the encoder's counts and the torque's noise
#: make of a joint that slides: a tenth of what counts as settled. An axis of two cycles swings out for a second; one
#: that does not rest at all is found by the long hold as well.
RIPPLE_SHARE = 0.002
RIPPLE_S = 0.2
SETTLED_SHARE = 0.02  # of the large step: a plant that is further off at its end does not get there
TORQUE_FACTOR = 3.0  # of the largest friction: the drive of the trials has no more, nor more than its limit
RAMP_SHARES = (0.001, 0.004, 0.02)  # of the top speed
RAMP_S = 4.0
LONG_HOLD_S = 20.0
#: Changes of the torque in one cycle that are tried, as shares of the drive's torque in the trials.
RATES = (2.0, 1.0, 0.5, 0.2, 0.1, 0.05)
GRID = 60  # speeds per direction at which the fall is looked for


@dataclass(frozen=True, slots=True)
class Scale:
    """The motions of one axis: steps and sine in rad, the drive's torque in N*m, by its speeds and its friction."""

    top_rad_s: float
    peak_rad_s: float
    torque_nm: float

    @property
    def small_rad(self) -> float:
        """The small step."""
        return SMALL_STEP_S * self.top_rad_s

    @property
    def large_rad(self) -> float:
        """The large step."""
        return LARGE_STEP_S * self.top_rad_s

    @property
    def sine_rad(self) -> float:
        """Amplitude of the sine."""
        return self.peak_rad_s / (2.0 * math.pi * SINE_HZ)


def scale_of(design: Design) -> Scale:
    """Motions that pass the fall of this axis's friction, in both directions, within the speeds of its design."""
    friction, top = steady_friction(design.model), design.speed_max_rad_s
    falls = []
    for side in (1.0, -1.0):
        speeds = [float(v) for v in np.geomspace(0.01 * top, top, GRID)]
        slopes = [friction.dry_slope(side * v) + friction.viscous(side * v) for v in speeds]
        falls += [speeds[int(np.argmin(slopes))]] if min(slopes) < 0.0 else []
    peak = max([PAST_FALL * speed for speed in falls], default=0.0)
    torque = min(TORQUE_FACTOR * friction.largest(top), design.torque_limit_nm or math.inf)
    return Scale(top, min(max(peak, LEAST_PEAK * top), top), torque)


@dataclass(frozen=True, slots=True)
class Sample:
    """One plant's figures: largest error as a share of the sine; ripple and rest as shares of the large step."""

    index: int
    error_share: float
    ripple_share: float
    unsettled_share: float

    @property
    def follows(self) -> bool:
        """Whether the plant followed the sine."""
        return self.error_share < ERROR_SHARE

    @property
    def rests(self) -> bool:
        """Whether it came to rest after the sine and after the large step."""
        return self.ripple_share < RIPPLE_SHARE

    @property
    def arrives(self) -> bool:
        """Whether it got to the end of the large step."""
        return self.unsettled_share < SETTLED_SHARE

    @property
    def stable(self) -> bool:
        """All three."""
        return self.follows and self.rests and self.arrives


def counts(period_s: float) -> list[int]:
    """Cycles of the parts of the trial motion: rest, small step, sine, hold, large step."""
    return [round(t / period_s) for t in (LEAD_IN_S, STEP_S, SINE_S, HOLD_S, LARGE_S)]


def trial_motion(period_s: float, scale: Scale) -> Array:
    """Rest, small step, sine through both directions, rest, large step: rows of position, velocity, acceleration."""
    lengths = counts(period_s)
    parts = [np.zeros((n, 3)) for n in lengths]
    w, t, amplitude = 2.0 * math.pi * SINE_HZ, np.arange(lengths[2]) * period_s, scale.sine_rad
    parts[2][:, 0], parts[2][:, 1] = amplitude * np.sin(w * t), amplitude * w * np.cos(w * t)
    parts[2][:, 2] = -amplitude * w * w * np.sin(w * t)
    parts[4][:, 0] = scale.large_rad
    motion = np.concatenate(parts)
    motion[lengths[0] :, 0] += scale.small_rad
    return motion


def quiet(plant: AxisModel, resolution_rad: float) -> AxisModel:
    """`plant` with its encoder's noise but none in its torque: what still moves there moves by itself."""
    noise = noise_of(plant, resolution_rad) or Noise()
    return plant.model_copy(update={"noise": noise.model_copy(update={"torque_rms": 0.0})})


def simulated(
    gains: GainSet, design: Design, plant: AxisModel, motion: Array, seed: int, rate_nm_per_s: float = math.inf
) -> tuple[Array, Array]:
    """(tracking error, position) of one plant along `motion`, with noise, encoder steps and a drive's torque limits."""
    settings = LoopSettings(
        design.period_s,
        design.counts_per_turn,
        design.velocity_cutoff_hz,
        scale_of(design).torque_nm,
        torque_rate_nm_per_s=rate_nm_per_s,
    )
    noise = noise_of(plant, settings.resolution_rad)
    torque, reading = noise_series(noise, len(motion), design.period_s, seed)
    run = simulate_closed_loop(
        plant,
        gains.law,
        gains.pack(),
        motion,
        settings,
        external_nm=torque,
        reading_rad=reading,
    )
    return run.tracking_error_rad(), run.position_rad


def run_sample(
    gains: GainSet,
    design: Design,
    motion: Array,
    seed: int,
    index: int,
    shaken_rad: float = 0.0,
    rate_nm_per_s: float = math.inf,
) -> Sample:
    """One plant of the Monte-Carlo; a plant that runs away counts with infinite figures.

    `shaken_rad`: how far counts and noise alone may move a joint, peak to peak; no part of the ripple.
    """
    plant = drawn(design.model, design.uncertainty, seed, index)
    error, position = simulated(gains, design, plant, motion, index, rate_nm_per_s)
    if not np.isfinite(position).all():
        return Sample(index, math.inf, math.inf, math.inf)
    scale, ends, last = scale_of(design), np.cumsum(counts(design.period_s)), round(RIPPLE_S / design.period_s)
    sine = error[ends[1] + last : ends[2]]  # the sine starts with a jump of velocity
    rests = [np.ptp(position[end - last : end]) for end in (ends[3], ends[4])]
    return Sample(
        index,
        float(np.abs(sine).max()) / scale.sine_rad,
        max(float(max(rests)) - shaken_rad, 0.0) / scale.large_rad,
        float(np.abs(error[-last:]).max()) / scale.large_rad,
    )


def _trials(gains: GainSet, seed: int, shaken_rad: float, first: int, last: int) -> list[Sample]:
    assert gains.design is not None
    motion = trial_motion(gains.design.period_s, scale_of(gains.design))
    return [run_sample(gains, gains.design, motion, seed, i, shaken_rad) for i in range(first, last)]


def _worker(text: str, seed: int, shaken_rad: float, first: int, last: int) -> list[Sample]:
    from servod.formats.gains.gain_set import parse_gains

    return _trials(parse_gains(text, "gain set"), seed, shaken_rad, first, last)


def monte_carlo(gains: GainSet, plants: int, seed: int, processes: int, shaken_rad: float = 0.0) -> list[Sample]:
    """`plants` trials over worker processes; the same seed gives the same plants whatever the number of processes."""
    if processes <= 1:
        return _trials(gains, seed, shaken_rad, 0, plants)
    text, cuts = gains.to_yaml(), [plants * i // processes for i in range(processes + 1)]
    with worker_pool(processes) as pool:
        parts = [pool.submit(_worker, text, seed, shaken_rad, *ends) for ends in pairwise(cuts)]
        return [trial for part in parts for trial in part.result()]


def fastest_rate(design: Design) -> float:
    """A change of the torque from one limit to the other in one cycle [N*m/s]: as if there were no bound."""
    return RATES[0] * scale_of(design).torque_nm / design.period_s


def least_rate(gains: GainSet, plants: int, seed: int, shaken_rad: float) -> float:
    """The slowest change of the torque [N*m/s], of RATES, at which and above which `plants` plants stand the motion.

    inf where they do not even with the fastest.
    """
    assert gains.design is not None
    design, scale, least = gains.design, scale_of(gains.design), math.inf
    motion = trial_motion(design.period_s, scale)
    for share in RATES:
        rate = share * scale.torque_nm / design.period_s
        samples = (run_sample(gains, design, motion, seed, i, shaken_rad, rate) for i in range(plants))
        if not all(sample.stable for sample in samples):
            break
        least = rate
    return least


def hold_ripple(gains: GainSet, design: Design, plant: AxisModel) -> float:
    """Peak to peak position over the last 15 s of a 20 s hold after a step [rad]: a limit cycle shows here."""
    motion = np.zeros((round(LONG_HOLD_S / design.period_s), 3))
    motion[round(LEAD_IN_S / design.period_s) :, 0] = scale_of(design).small_rad
    _, position = simulated(gains, design, plant, motion, 0)
    return float(np.ptp(position[len(position) // 4 :])) if np.isfinite(position).all() else math.inf


def ramp_ripples(gains: GainSet, design: Design, plant: AxisModel) -> Iterator[float]:
    """Peak to peak tracking error of slow ramps in both directions, after their first quarter [rad]: stick-slip."""
    t = np.arange(round(RAMP_S / design.period_s)) * design.period_s
    top = design.speed_max_rad_s
    for speed in (side * share * top for share in RAMP_SHARES for side in (1.0, -1.0)):
        motion = np.stack([speed * t, np.full_like(t, speed), np.zeros_like(t)], axis=1)
        error, _ = simulated(gains, design, plant, motion, 0)
        yield float(np.ptp(error[len(t) // 4 :])) if np.isfinite(error).all() else math.inf
