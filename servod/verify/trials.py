"""Motions that a set must stand on simulated plants: Monte-Carlo over the intervals, long holds, slow ramps.

Stands on the compiled simulator. Runs in worker processes, so everything here is a plain function on plain values.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servod.axis_model import AxisModel
from servod.gain_design import Design
from servod.gains import GainSet
from servod.models.simulate import LoopSettings, simulate_closed_loop
from servod.verify.plants import drawn
from servod.verify.sampled import Array
from servod.workers import worker_pool

STEP_RAD = 0.01
SINE_RAD, SINE_HZ = 0.05, 0.25  # peak speed 79 mrad/s: through the fall of the Stribeck curve and back
LEAD_IN_S, STEP_S, SINE_S, HOLD_S = 0.1, 0.6, 4.0, 0.5
ERROR_LIMIT_RAD = 2e-3  # while it follows the sine: a plant beyond it does not follow
RIPPLE_LIMIT_RAD = 1e-4  # peak to peak over the last part of the hold, half a second after the motion
RAMPS_RAD_S = (0.0005, 0.002, 0.01)
RAMP_S = 4.0
LONG_HOLD_S = 20.0


@dataclass(frozen=True, slots=True)
class Trial:
    """One plant's figures: largest error on the sine, ripple at the end; `stable` is what they say together."""

    index: int
    error_rad: float
    ripple_rad: float

    @property
    def stable(self) -> bool:
        """Whether the plant followed and came to rest."""
        return self.error_rad < ERROR_LIMIT_RAD and self.ripple_rad < RIPPLE_LIMIT_RAD


def trial_motion(period_s: float) -> Array:
    """Rest, a step, a sine through both directions, rest: rows of position, velocity, acceleration."""
    counts = [round(t / period_s) for t in (LEAD_IN_S, STEP_S, SINE_S, HOLD_S)]
    parts = [np.zeros((counts[0], 3)), np.zeros((counts[1], 3)), np.zeros((counts[2], 3)), np.zeros((counts[3], 3))]
    w, t = 2.0 * math.pi * SINE_HZ, np.arange(counts[2]) * period_s
    parts[2][:, 0], parts[2][:, 1] = SINE_RAD * np.sin(w * t), SINE_RAD * w * np.cos(w * t)
    parts[2][:, 2] = -SINE_RAD * w * w * np.sin(w * t)
    motion = np.concatenate(parts)
    motion[counts[0] :, 0] += STEP_RAD
    return motion


def settings_of(design: Design, model: AxisModel) -> LoopSettings:
    """Loop around the law as the design states it."""
    return LoopSettings(design.period_s, design.counts_per_turn, design.velocity_cutoff_hz, delay_s=model.total_delay_s)


def simulated(gains: GainSet, design: Design, plant: AxisModel, motion: Array, seed: int) -> tuple[Array, Array]:
    """(tracking error, position) of one plant along `motion`, with the model's torque noise."""
    noise = plant.noise.torque_rms if plant.noise else 0.0
    external = np.random.default_rng(seed).normal(0.0, noise, len(motion)) if noise else None
    run = simulate_closed_loop(
        plant, gains.law.step, gains.pack(), motion, settings_of(design, plant), external_nm=external
    )
    return run.tracking_error_rad(), run.position_rad


def run_trial(gains: GainSet, design: Design, motion: Array, seed: int, index: int) -> Trial:
    """One plant of the Monte-Carlo; a plant that runs away counts with an infinite error."""
    error, position = simulated(gains, design, drawn(design.model, design.uncertainty, seed, index), motion, index)
    if not np.isfinite(position).all():
        return Trial(index, math.inf, math.inf)
    start = round((LEAD_IN_S + STEP_S + 0.2) / design.period_s)  # the sine starts with a jump of velocity
    end = round((LEAD_IN_S + STEP_S + SINE_S) / design.period_s)
    return Trial(index, float(np.abs(error[start:end]).max()), float(np.ptp(position[-round(0.2 / design.period_s) :])))


def _worker(text: str, seed: int, first: int, last: int) -> list[Trial]:
    from servod.gains import parse_gains

    gains = parse_gains(text, "gain set")
    assert gains.design is not None
    motion = trial_motion(gains.design.period_s)
    return [run_trial(gains, gains.design, motion, seed, i) for i in range(first, last)]


def monte_carlo(gains: GainSet, plants: int, seed: int, processes: int) -> list[Trial]:
    """`plants` trials over worker processes; the same seed gives the same plants whatever the number of processes."""
    text = gains.to_yaml()
    if processes <= 1:
        return _worker(text, seed, 0, plants)
    cuts = [plants * i // processes for i in range(processes + 1)]
    with worker_pool(processes) as pool:
        parts = pool.starmap(_worker, [(text, seed, *ends) for ends in pairwise(cuts)])
        return [trial for part in parts for trial in part]


def hold_ripple(gains: GainSet, design: Design, plant: AxisModel) -> float:
    """Peak to peak position over the last 15 s of a 20 s hold after a step [rad]: a limit cycle shows here."""
    motion = np.zeros((round(LONG_HOLD_S / design.period_s), 3))
    motion[100:, 0] = STEP_RAD
    _, position = simulated(gains, design, plant, motion, 0)
    return float(np.ptp(position[len(position) // 4 :])) if np.isfinite(position).all() else math.inf


def ramp_ripples(gains: GainSet, design: Design, plant: AxisModel) -> Iterator[float]:
    """Peak to peak tracking error of slow ramps in both directions, after their first quarter [rad]: stick-slip."""
    t = np.arange(round(RAMP_S / design.period_s)) * design.period_s
    for speed in (side * v for v in RAMPS_RAD_S for side in (1.0, -1.0)):
        motion = np.stack([speed * t, np.full_like(t, speed), np.zeros_like(t)], axis=1)
        error, _ = simulated(gains, design, plant, motion, 0)
        yield float(np.ptp(error[len(t) // 4 :])) if np.isfinite(error).all() else math.inf
