"""What the law adds beside its feedback, against the model: friction, torques over position, inertia, and their leads.

Beside `checks`. A feed-forward closes no loop, so no pole tells of it: a law that pushes with what its joint has not is
found here. What it gives too little is left to its feedback: a torque over position that it does not know at all is
judged by the motions, a map of friction with a hole in it is none of this joint.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from servod.formats.gains.gain_set import CertificateCheck
from servod.formats.gains.parameters import LocalParameters, PositionFeedforward
from servod.formats.model.axis_model import AxisModel, wave_number
from servod.lab.verify.checks import SAME, SLOWEST, Subject, at_most
from servod.lab.verify.law_slopes import settled_state
from servod.lab.verify.steady_friction import SPRING_STRETCH_RAD, steady_friction

#: Beyond its interval the friction may be compensated by so much too much, as a share: what weights between nodes make.
OVER_LIMIT = 0.05
#: Below its interval so much of the friction may be left out: the paper's own nine nodes leave 0.2 between them.
UNDER_LIMIT = 0.3
#: The leak of z_hat takes from slow sets on purpose, so that nothing creeps: only decays of so many leaks are judged.
ABOVE_LEAK = 5.0
#: Of the largest friction: what the law may know of torques over position and the model does not.
UNKNOWN_SHARE = 0.02
#: A command acts in the middle of its period, behind delay and lag; a lead may be longer by these cycles.
LEAD_CYCLES = 2.0
STEADY_SPEEDS = 60  # per direction, beside the law's own nodes


def check_feedforward(s: Subject) -> Iterator[CertificateCheck]:
    """Nothing is added to the feedback that the model has not."""
    local = s.gains.parameters
    if not isinstance(local, LocalParameters):
        return
    shares = [share for side in (1.0, -1.0) for share in compensated(s, local, side)]
    over, under = max(share[0] for share in shares), max(share[1] for share in shares)
    yield at_most("friction compensated beyond its interval, as a share of it", over, OVER_LIMIT)
    yield at_most("friction left out below its interval, as a share of it", under, UNDER_LIMIT)
    inertia = local.feedforward_inertia_kg_m2 / s.coarse.friction.inertia
    most = 1.0 + max(s.design.uncertainty.inertia, SAME)
    yield at_most("inertia of the feed-forward over the model's", inertia, most)
    known, cycle_s = local.position_feedforward, s.design.period_s
    lead_s = max(local.friction.lead_s, known.lead_s if known else 0.0)
    yield at_most("lead of the feed-forward [s]", lead_s, s.design.model.acts_after_s + LEAD_CYCLES * cycle_s)
    if known is not None:
        limit = UNKNOWN_SHARE * s.coarse.friction.largest(s.design.speed_max_rad_s)
        yield at_most("torque over position that the model has not [N*m]", unknown_nm(known, s.design.model), limit)


def compensated(s: Subject, local: LocalParameters, side: float) -> Iterator[tuple[float, float]]:
    """(over, under) at each speed of one direction: by how much the law's own steady compensation is above and below
    the interval of the friction, as shares of the friction there; 0.0 and less within it."""
    friction, u, law = s.coarse.friction, s.design.uncertainty, s.gains.law
    p, top = law.named(s.gains.pack()), s.design.speed_max_rad_s
    speeds = [float(v) for v in np.geomspace(SLOWEST * top, top, STEADY_SPEEDS)]
    for speed in sorted({*speeds, *(v for v in s.own_speeds if v <= top)}):
        velocity = side * speed
        state = settled_state(law, s.gains.pack(), velocity, True, s.design.period_s)
        given = side * (p.stiffness * state.z_hat + p.viscous * velocity)
        dry, viscous = friction.dry(velocity), friction.viscous(velocity) * speed
        half, truth = u.dry * dry + u.viscous * viscous, dry + viscous
        slow = p.stiffness * speed < ABOVE_LEAK * local.friction.leak_per_s * truth
        yield (given - truth - half) / truth, 0.0 if slow else (truth - half - given) / truth


def unknown_nm(known: PositionFeedforward, model: AxisModel) -> float:
    """Bound of the torque by which `known` differs from the same terms of the model, per unit of its torque gain."""
    gain = steady_friction(model).gain
    waves = _waves(model, gain)
    used: dict[float, complex] = {}
    for wave in known.waves:
        used[wave.waves_per_turn] = used.get(wave.waves_per_turn, 0.0) + _phasor(wave.amplitude_nm, wave.phase_rad)
    differs = sum(abs(phasor - waves.get(number, 0.0)) for number, phasor in used.items())
    if known.offset_nm:
        differs += abs(known.offset_nm + model.torque_offset / gain)
    return differs + _spring_differs(known, model, gain)


def _phasor(amplitude: float, phase_rad: float) -> complex:
    return amplitude * complex(math.cos(phase_rad), math.sin(phase_rad))


def _waves(model: AxisModel, gain: float) -> dict[float, complex]:
    """Phasors of gravity and cogging together, by their waves a turn."""
    found: dict[float, complex] = {}
    terms = [(1.0, model.gravity.amplitude, model.gravity.phase)] if model.gravity else []
    terms += [(wave_number(h), h.amplitude, h.phase) for h in (model.cogging.harmonics if model.cogging else ())]
    for number, amplitude, phase in terms:
        found[number] = found.get(number, 0.0) + _phasor(amplitude / gain, phase)
    return found


def _spring_differs(known: PositionFeedforward, model: AxisModel, gain: float) -> float:
    """Largest difference of both springs within SPRING_STRETCH_RAD of their rests; 0.0 where the law knows none."""
    if known.spring_nm_per_rad == known.spring_cubic_nm_per_rad3 == 0.0:
        return 0.0
    own = model.spring
    reach = np.linspace(-SPRING_STRETCH_RAD, SPRING_STRETCH_RAD, 101)
    x = np.concatenate([reach + known.spring_rest_rad, reach + (own.rest if own else 0.0)])
    stretch = x - known.spring_rest_rad
    given = (known.spring_nm_per_rad + known.spring_cubic_nm_per_rad3 * stretch**2) * stretch
    if own is None:
        return float(np.abs(given).max())
    stretch = x - own.rest
    return float(np.abs(given - (own.stiffness + own.cubic * stretch**2) * stretch / gain).max())
