"""What only the compiled simulator is fast enough for: sweeps of l, readings of the gains, friction with noise on it.

Jobs of the pool, all on Table I's joint. What the simulator leaves out: the drive's steps of torque and its rate limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servod.client.virtual import PEAK_RATIO, rated_torque_mnm
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel
from servod.kernels.motions import sine
from servod.lab.report.figure import Array, array
from servod.lab.report.figures.motion import SETTLE_S, PlottedMotion, motion_of_run
from servod.lab.simulate.simulate import ClosedLoopRun, LoopSettings, simulate_closed_loop
from servod.lab.tracking.metrics import paper_rows
from servod.qualify.paper.experiments import cutoff_of
from servod.qualify.paper.joints import ENCODER_COUNTS, PaperJoint, with_l
from servod.qualify.paper.printed import L_I, SINE_HZ, SINE_RAD

PERIOD_S = 0.001
#: What counts for a joint that runs away: a hundred times the trajectory.
RAN_AWAY_MRAD = 1e4
#: Cut-off of the noise that tunes friction (Fig. 11): slow against the loop, fast against the reference.
NOISE_HZ = 2.0
#: RMS of that noise as shares of F_C; the paper prints neither.
NOISE_SHARES = (0.05, 0.1, 0.2)

#: Signs of l_i in the sweep, each times a factor: the printed pattern, and its sizes with one sign for all sets.
SIGNS: Mapping[str, tuple[float, ...]] = {
    "l > 0: ẑ pushes as the feedback does": tuple(abs(l_i) for l_i in L_I),
    "l < 0": tuple(-abs(l_i) for l_i in L_I),
    "signs as printed": L_I,
}
FACTORS = tuple(float(f) for f in np.geomspace(0.002, 1.0, 10))


@dataclass(frozen=True)
class SweepOfL:
    """RMS error of (19) in mrad over the factor on the printed K_i, by sign; `without` is l = 0."""

    factors: tuple[float, ...]
    rms_mrad: dict[str, tuple[float, ...]]
    without: float


def simulate(plant: AxisModel, gains: GainSet, rows: Array, external_nm: Array | None = None) -> ClosedLoopRun:
    """One motion on the compiled simulator, with encoder, velocity filter and torque limit of the virtual axis."""
    limit_nm = PEAK_RATIO * rated_torque_mnm(plant) * 1e-3
    settings = LoopSettings(PERIOD_S, ENCODER_COUNTS, cutoff_of(gains), limit_nm)
    return simulate_closed_loop(plant, gains.law, gains.pack(), rows, settings, external_nm=external_nm)


def rms_mrad(plant: AxisModel, gains: GainSet, seconds: float, external_nm: Array | None = None) -> float:
    """RMS error of (19) without its first second; RAN_AWAY_MRAD at most."""
    run = simulate(plant, gains, paper_rows(PERIOD_S, seconds), external_nm)
    rms = 1e3 * float(np.sqrt(np.mean(run.tracking_error_rad(SETTLE_S) ** 2)))
    return min(rms, RAN_AWAY_MRAD) if math.isfinite(rms) else RAN_AWAY_MRAD


def sweep_of_l(gains: GainSet, seconds: float, factors: Sequence[float] = FACTORS) -> SweepOfL:
    """Track (19) with each sign and size of l_i."""
    plant = PaperJoint.TABLE1.model()
    found = {
        sign: tuple(rms_mrad(plant, with_l(gains, "sweep", [f * l_i for l_i in values]), seconds) for f in factors)
        for sign, values in SIGNS.items()
    }
    return SweepOfL(tuple(factors), found, rms_mrad(plant, with_l(gains, "sweep", [0.0] * len(L_I)), seconds))


def filtered_noise(rms_nm: float, samples: int, seed: int) -> Array:
    """White noise through a first-order low-pass of NOISE_HZ, scaled to `rms_nm` exactly."""
    kept = math.exp(-2.0 * math.pi * NOISE_HZ * PERIOD_S)
    value, out = 0.0, []
    for fresh in np.random.default_rng(seed).normal(size=samples).tolist():
        value = kept * value + (1.0 - kept) * fresh
        out.append(value)
    noise = array(out)
    return noise * (rms_nm / float(np.sqrt(np.mean(noise**2))))


def under_noise(sets: Mapping[str, GainSet], coulomb_nm: float, seconds: float, seed: int) -> dict[str, list[float]]:
    """RMS error of (19) in mrad for no noise and each of NOISE_SHARES, by label."""
    plant, samples = PaperJoint.TABLE1.model(), round(seconds / PERIOD_S)
    pushes = [-filtered_noise(share * coulomb_nm, samples, seed) for share in NOISE_SHARES]
    return {
        label: [rms_mrad(plant, gains, seconds), *(rms_mrad(plant, gains, seconds, push) for push in pushes)]
        for label, gains in sets.items()
    }


def on_sine(label: str, gains: GainSet, seconds: float, noise_nm: float = 0.0, seed: int = 0) -> PlottedMotion:
    """The sine of Fig. 9 to 12 with the joint's own friction; `noise_nm` is the RMS of what is added to it."""
    plant, path = PaperJoint.TABLE1.model(), sine(SINE_RAD, SINE_HZ)
    rows = array([path((k + 1) * PERIOD_S) for k in range(round(seconds / PERIOD_S))])
    push = -filtered_noise(noise_nm, len(rows), seed) if noise_nm else None
    run = simulate(plant, gains, rows, push)
    return motion_of_run(label, run, joint_friction(plant, run))


def joint_friction(plant: AxisModel, run: ClosedLoopRun) -> Array:
    """Friction of the joint, mean over each cycle, from the balance of momentum: what acted, less what accelerated.

    A disturbance beside the command counts as friction.
    """
    late = round(plant.total_delay_s / PERIOD_S)
    acting = np.concatenate([np.zeros(late), run.torque_nm[: len(run.torque_nm) - late]])
    gained = np.diff(run.true_velocity_rad_s, append=run.true_velocity_rad_s[-1]) / PERIOD_S
    friction: Array = acting - plant.inertia * gained
    return friction
