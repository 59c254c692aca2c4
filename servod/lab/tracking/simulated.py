"""Tracking on the compiled simulator: the same motions and rules as over the CAN loop, hundreds of times faster.

Stands on `servod.lab.simulate.simulate`. What the simulator leaves out: the drive's steps of torque and its rate limit.
"""

from __future__ import annotations

import math

import numpy as np

from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel
from servod.lab.simulate.noise import noise_series
from servod.lab.simulate.simulate import ClosedLoopRun, LoopSettings, simulate_closed_loop
from servod.lab.tracking.metrics import HOLD_FROM_S, Array, Curves, Tracking, tracking
from servod.lab.tracking.motions import HOLD_S, PAPER_S, STEPS_MRAD, paper_rows, step_rows


def measure(
    model: AxisModel,
    gains: GainSet,
    *,
    counts_per_turn: float,
    cutoff_hz: float,
    seed: int,
    torque_limit_nm: float = math.inf,
    period_s: float = 0.001,
) -> Tracking:
    """Simulate `model` under `gains` on (19) and on steps of 100 and 10 mrad held for 20 s, each from rest.

    `seed` begins the model's torque and encoder noise. Curves hold what the encoder showed.
    """
    settings = LoopSettings(period_s, counts_per_turn, cutoff_hz, torque_limit_nm)
    followed = run(model, gains, paper_rows(period_s, PAPER_S), settings, seed)
    runs = {
        size: run(model, gains, step_rows(period_s, size, HOLD_S), settings, seed + 1 + i)
        for i, size in enumerate(STEPS_MRAD)
    }
    swings = {size: float(np.ptp(r.position_rad[r.t_s >= HOLD_FROM_S])) for size, r in runs.items()}
    steps = {size: curves_of(r) for size, r in runs.items()}
    heard_rad = model.noise.encoder_rms if model.noise else 0.0
    return tracking(curves_of(followed), steps, settings.resolution_rad, swings, heard_rad)


def run(model: AxisModel, gains: GainSet, rows: Array, settings: LoopSettings, seed: int) -> ClosedLoopRun:
    """One motion from rest at 0, with the model's own noise."""
    torque, reading = noise_series(model.noise, len(rows), settings.period_s, seed)
    return simulate_closed_loop(
        model,
        gains.law.step,
        gains.pack(),
        rows,
        settings,
        external_nm=torque,
        reading_rad=reading,
        start=(0.0, 0.0, 0.0),
    )


def curves_of(motion: ClosedLoopRun) -> Curves:
    """What an encoder and a recorder would have shown of `motion`."""
    return Curves(
        time_s=motion.t_s,
        reference_rad=motion.reference_rad,
        position_rad=motion.encoder_rad,
        torque_nm=motion.torque_nm,
        feedback_nm=motion.feedback_nm,
        friction_nm=motion.friction_nm,
        other_nm=motion.other_nm,
    )
