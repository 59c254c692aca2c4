"""Whether a joint that counts as at rest is still held: its widths, its loop with the feedback at rest, and its loads.

Beside `checks`, whose table of motions has no load. At rest only a share of feedback and observer acts. The law wakes
where the error leaves the width, within REST_FROM_S: a joint that slides faster than twice the width in that time has
left it before a pole could tell. So the loop is linearised at rest up to that speed, and faster sliding, which can
only begin at rest and not last there, is judged by simulation: blows that throw a resting joint to those speeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise, product

import numpy as np

from servod.formats.gains.gain_set import CertificateCheck, GainSet
from servod.formats.gains.parameters import LocalParameters
from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws.local import REST_FROM_S
from servod.lab.simulate.noise import noise_of, noise_series
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.verify.checks import HOLD_LIMIT_RAD, SAME, Subject, at_least, at_most, speeds_of
from servod.lab.verify.closed_loop import LinearBristle, corners, loops_around, spectral_radius
from servod.lab.verify.law_slopes import LawSlopes, arriving_slopes
from servod.lab.verify.margins import by_delay, joints_at
from servod.lab.verify.plants import drawn
from servod.lab.verify.rounding import LEAST_SHARE, count_rad, hold_width, rest_width
from servod.lab.verify.sampled import Array
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.trials import quiet, scale_of

RESTING_SPEEDS = 6  # per direction
#: A joint that creeps on its bristle comes back as slowly as it creeps: its pole is inside by that, not by POLE_LIMIT.
RESTING_POLE = 1.0 - 1e-6
BETWEEN = 0.5  # of the way from the hold width to the rest width, where a joint is at rest and its integrals act
LOAD_SHARE = 0.6  # of the torque at which the joint breaks away
#: A joint without feedback gives way by load over stiffness. Held, it swings out at a step and comes back; a slow load
#: it follows by less than half of that.
STEP_GIVES, SINE_GIVES = 4.0, 0.5
WAKING = 1.5  # of what the law lets happen that never rests: waking takes some cycles, in which the joint goes on
LEAD_IN_S, STEP_S, SINE_S, SINE_HZ, BLOW_S, JUDGED_S = 1.0, 6.0, 6.0, 0.2, 2.0, 0.5
BLOWS = 4
LOADED_PLANTS = 2


def check_rest(s: Subject) -> Iterator[CertificateCheck]:
    """Widths of the set against what rounding and noise of its encoder make, and the share that is left at rest."""
    local = s.gains.parameters
    if not isinstance(local, LocalParameters):
        return
    hold, rest = hold_width(s.design), rest_width(s.design)
    yield at_most("hold width [rad]", local.hold_within_rad, hold * (1.0 + SAME))
    yield at_most("width within which a joint is at rest [rad]", local.rest_within_rad or 0.0, rest * (1.0 + SAME))
    if local.rest_within_rad:
        share = 1.0 if local.rest_share is None else local.rest_share
        yield at_least("share of the feedback that is left at rest", share, LEAST_SHARE)
        slow = resting_speed(local.rest_within_rad)
        name = f"largest pole, at rest, corners, standing and sliding up to {slow:.2g} rad/s"
        yield at_most(name, resting_radius(s, local, slow), RESTING_POLE)


def resting_speed(rest_within_rad: float) -> float:
    """Speed beyond which a joint has left the width before a pole could tell [rad/s]."""
    return 2.0 * rest_within_rad / REST_FROM_S


def resting_radius(s: Subject, local: LocalParameters, below_rad_s: float) -> float:
    """Largest pole within the rest width: holding and beyond, sticking and sliding, at rest and just awake."""
    cases, worst = corners(s.design.uncertainty), 0.0
    for velocity, slopes in resting_slopes(s, local, below_rad_s):
        for group in by_delay(cases):
            own = tuple(cases[i] for i in group)
            timing = s.timing.later_by(own[0].delay_s)
            for kind in LinearBristle if velocity else (LinearBristle.STICKS,):
                joints = joints_at(s.coarse.friction, velocity, kind, own, timing)
                worst = max(worst, float(spectral_radius(loops_around(*joints, slopes)[0]).max()))
    return worst


def resting_slopes(s: Subject, local: LocalParameters, below_rad_s: float) -> Iterator[tuple[float, LawSlopes]]:
    """(velocity, linearised law) at rest and just awake, within the hold width and between it and the rest width."""
    hold, width = local.hold_within_rad, local.rest_within_rad or 0.0
    errors = [0.0] + ([hold + BETWEEN * (width - hold)] if width > hold * (1.0 + SAME) else [])
    slowest = speeds_of(s.design, 2)[0]
    speeds = np.geomspace(min(slowest, below_rad_s), below_rad_s, RESTING_SPEEDS).tolist()
    for rest, error, velocity in product((1.0, 0.0), errors, (0.0, *speeds, *(-v for v in speeds))):
        slopes = arriving_slopes(s.gains.law, s.gains.pack(), velocity, error, s.timing, rest)
        yield velocity, slopes.coupled()


def check_loads(s: Subject) -> Iterator[CertificateCheck]:
    """A step and a slow sine of load below break-away on a held joint, and blows that make it slide out of its rest.

    Without torque noise, on the model and drawn plants. What is too much is accepted only where the same law that
    never rests lets a joint go nearly as far: it is the law's stiffness then, which other checks judge.
    """
    count = count_rad(s.design)
    plants = [s.design.model, *(drawn(s.design.model, s.design.uncertainty, s.seed, i) for i in range(LOADED_PLANTS))]
    still = [quiet(plant, count) for plant in plants]
    friction = steady_friction(s.design.model)
    load = LOAD_SHARE * min(friction.dry(side * 1e-9) for side in (1.0, -1.0))
    gives, left = load / friction.stiffness, rest_width(s.design) + HOLD_LIMIT_RAD
    step, slow = load_step(s, load), slow_load(s, load)
    yield judged(s, still, "load step, greatest deviation [rad]", step, greatest, STEP_GIVES * gives + left)
    yield judged(s, still, "load step, deviation at its end [rad]", step, largest_in_last_second(s), left)
    yield judged(s, still, "slow load, greatest deviation [rad]", slow, greatest, SINE_GIVES * gives + left)
    yield judged(s, still, "blows at rest, deviation 1.5 s after [rad]", blows(s), after_blows(s), left)


def judged(
    s: Subject, plants: Sequence[AxisModel], name: str, load_nm: Array, figure: Callable[[Array], float], limit: float
) -> CertificateCheck:
    """The worst figure over `plants`, against `limit` or, beyond it, what the law lets happen that never rests."""
    worst = max(figure(loaded(s, s.gains, plant, load_nm)) for plant in plants)
    if worst > limit:
        awake = max(figure(loaded(s, never_resting(s.gains), plant, load_nm)) for plant in plants)
        limit = max(limit, WAKING * awake)
    return at_most(name, worst, limit)


def never_resting(gains: GainSet) -> GainSet:
    """The same set, awake for ever."""
    awake = {"rest_within_rad": None, "rest_share": None}
    return gains.model_copy(update={"parameters": gains.parameters.model_copy(update=awake)})


def loaded(s: Subject, gains: GainSet, plant: AxisModel, load_nm: Array) -> Array:
    """True position of a joint that is held at zero under `load_nm`, a value for each cycle [rad]."""
    design, n = s.design, len(load_nm)
    torque_nm = scale_of(design).torque_nm
    settings = LoopSettings(design.period_s, design.counts_per_turn, design.velocity_cutoff_hz, torque_nm)
    torque, reading = noise_series(noise_of(plant, settings.resolution_rad), n, design.period_s, s.seed)
    run = simulate_closed_loop(
        plant,
        gains.law,
        gains.pack(),
        np.zeros((n, 3)),
        settings,
        external_nm=torque + load_nm,
        reading_rad=reading,
    )
    return run.position_rad


def load_step(s: Subject, load_nm: float) -> Array:
    """A load that comes after LEAD_IN_S and stays."""
    t = np.arange(round(STEP_S / s.design.period_s)) * s.design.period_s
    return np.where(t >= LEAD_IN_S, load_nm, 0.0)


def slow_load(s: Subject, load_nm: float) -> Array:
    """A load that comes and goes in both directions, slowly."""
    t = np.arange(round((LEAD_IN_S + SINE_S) / s.design.period_s)) * s.design.period_s
    course: Array = load_nm * np.sin(2.0 * math.pi * SINE_HZ * np.maximum(t - LEAD_IN_S, 0.0))
    return course


def blows(s: Subject) -> Array:
    """One-cycle blows every BLOW_S, to either side, that take a resting joint to speeds from the slowest to the top."""
    design, friction = s.design, steady_friction(s.design.model)
    load = np.zeros(round((LEAD_IN_S + BLOWS * BLOW_S) / design.period_s))
    top = design.speed_max_rad_s
    slowest = min(max(2.0 * rest_width(design) / REST_FROM_S, speeds_of(design, 2)[0]), top)
    for start, speed, side in zip(_starts(s), np.geomspace(slowest, top, BLOWS), (1.0, -1.0) * BLOWS, strict=False):
        load[start] = side * (friction.inertia * speed / design.period_s + friction.dry(side * 1e-9))
    return load


def _starts(s: Subject) -> list[int]:
    return [round((LEAD_IN_S + i * BLOW_S) / s.design.period_s) for i in range(BLOWS)]


def greatest(position_rad: Array) -> float:
    """Largest deviation; infinite where the joint ran away."""
    return float(np.abs(position_rad).max()) if np.isfinite(position_rad).all() else math.inf


def largest_in_last_second(s: Subject) -> Callable[[Array], float]:
    """The largest deviation in the last second."""
    return lambda position_rad: greatest(position_rad[-round(1.0 / s.design.period_s) :])


def after_blows(s: Subject) -> Callable[[Array], float]:
    """The largest deviation in the last JUDGED_S before the next blow, and at the end."""
    last = round(JUDGED_S / s.design.period_s)

    def figure(position_rad: Array) -> float:
        ends = [*_starts(s), len(position_rad)]
        return max(greatest(position_rad[end - last : end]) for _, end in pairwise(ends))

    return figure
