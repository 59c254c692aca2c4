"""Draws what is concealed over position: periodic torques, weights, springs, inertia, and an encoder off its axis.

Beside `hidden_friction` and `hidden_drive`. What repeats along the way repeats at least PERIODS times in the range.
"""

from __future__ import annotations

import math

from servod.qualify.blind import listed
from servod.qualify.blind.concealed import Concealed, Document, Draw

#: Least periods in the range of whatever is periodic in position.
PERIODS = 1.6


def position_dependent_friction(draw: Draw) -> Concealed:
    """A sine over position; otherwise a tight spot or a triangle."""
    share = min(draw.size(0.12, 0.35), 0.8)
    if draw.other and draw.flip():
        travel = draw.axis.motions.travel
        spot = {"factor": min(2.0 * share, 2.0), "position": draw.between(-0.4, 0.4) * travel, "width": 0.13 * travel}
        changes = {"spot_share": spot["factor"], "spot_place": spot["position"], "spot_width": spot["width"]}
        return Concealed(changes, spot, {listed.POSITION_DEPENDENT_FRICTION: {"bumps": [spot]}})
    order, phase = _order(draw, 2.0, 6.0), draw.between(0.0, 6.28)
    changes = {"grip_share": share, "grip_order": order, "grip_phase": phase, "grip_shape": _shape(draw)}
    return _periodic(draw, listed.POSITION_DEPENDENT_FRICTION, changes, order, share, phase)


def cogging(draw: Draw) -> Concealed:
    """A sine of some order with a weak second; otherwise a triangle or a leaning wave."""
    torque = draw.size(0.1, 0.5) * draw.physics.coulomb
    order, phase = _order(draw, 3.0, 9.0), draw.between(0.0, 6.28)
    second = torque * draw.between(0.0, 0.15)
    changes = {"cogging": torque, "cogging_order": order, "cogging_phase": phase}
    changes |= {"cogging_second": second, "cogging_shape": _shape(draw)}
    return _periodic(draw, listed.COGGING, changes, order, torque, phase, second)


def torque_ripple(draw: Draw) -> Concealed:
    """A share of the torque that goes with a sine of position; otherwise with another wave."""
    share = min(draw.size(0.06, 0.2), 0.45)
    order, phase = _order(draw, 2.5, 8.0), draw.between(0.0, 6.28)
    changes = {"ripple_share": share, "ripple_order": order, "ripple_phase": phase, "ripple_shape": _shape(draw)}
    return _periodic(draw, listed.TORQUE_RIPPLE, changes, order, share, phase)


def gravity(draw: Draw) -> Concealed:
    """A weight that nobody told of; otherwise on a linkage. Beside a known weight, the sum of both is to be found."""
    p = draw.physics
    torque, phase = draw.size(0.3, 1.5) * p.coulomb, draw.between(0.0, 6.28)
    sine = p.gravity * math.cos(p.gravity_phase) + torque * math.cos(phase)
    cosine = p.gravity * math.sin(p.gravity_phase) + torque * math.sin(phase)
    amplitude, turned = math.hypot(sine, cosine), math.atan2(cosine, sine)
    second = 0.12 * torque if draw.other else 0.0
    changes = {"gravity": amplitude, "gravity_phase": turned, "gravity_second": second}
    found = {"amplitude": amplitude, "phase": turned}
    believed = {"gravity": p.gravity, "gravity_phase": p.gravity_phase}
    return Concealed(changes, found, None if draw.other else {listed.GRAVITY: found}, believed, travel=0.9)


def spring(draw: Draw) -> Concealed:
    """A straight spring; otherwise one that stiffens or has some slack in the middle."""
    travel = draw.axis.motions.travel
    torque, rest = draw.size(0.4, 1.8) * draw.physics.coulomb, draw.between(-0.4, 0.4) * travel
    stiffness = torque / travel
    if draw.other and draw.flip():
        return Concealed({"spring": stiffness, "spring_rest": rest, "spring_slack": 0.1 * travel}, travel=1.2)
    cubic = 0.8 * stiffness / travel**2 if draw.other else 0.0
    found = {"stiffness": stiffness, "rest": rest, "cubic": cubic}
    changes = {"spring": stiffness, "spring_rest": rest, "spring_cubic": cubic}
    told = found if draw.other else {key: found[key] for key in ("stiffness", "rest")}
    return Concealed(changes, told, {listed.SPRING: found}, travel=0.9 if draw.other else 1.2)


def position_dependent_inertia(draw: Draw) -> Concealed:
    """Inertia with a sine of some periods a turn; otherwise a crank's, with a second harmonic."""
    share, order = min(draw.size(0.15, 0.35), 0.6), draw.one_of(2.0, 3.0)
    phase, second = draw.between(0.0, 6.28), 0.2 * share if draw.other else 0.0
    changes = {"swing_share": share, "swing_order": order, "swing_phase": phase, "swing_second": second}
    rows = _rows(order, share, phase, second)
    travel = PERIODS * math.pi / order
    return Concealed(changes, _first(rows), {listed.POSITION_DEPENDENT_INERTIA: {"harmonics": rows}}, travel=travel)


def encoder_eccentricity(draw: Draw) -> Concealed:
    """A disc off its axis or oval; otherwise both."""
    order, phase = draw.one_of(1.0, 2.0), draw.between(0.0, 6.28)
    amplitude = min(draw.size(0.01, 0.03), 0.12) / order
    second = 0.15 * amplitude if draw.other else 0.0
    changes = {"eccentricity": amplitude, "eccentricity_order": order, "eccentricity_phase": phase}
    changes["eccentricity_second"] = second
    rows = _rows(order, amplitude, phase, second)
    travel = PERIODS * math.pi / order
    return Concealed(changes, _first(rows), {listed.ENCODER_ECCENTRICITY: {"harmonics": rows}}, travel=travel)


def _order(draw: Draw, least: float, most: float) -> float:
    """Whole periods in a turn, of which between `least` and `most` are in the range."""
    turns = 2.0 * draw.axis.motions.travel / (2.0 * math.pi)
    return max(float(round(draw.between(least, most) / turns)), math.ceil(PERIODS / turns))


def _shape(draw: Draw) -> float:
    return draw.one_of(1.0, 2.0) if draw.other else 0.0


def _periodic(
    draw: Draw, group: str, changes: dict[str, float], order: float, amplitude: float, phase: float, second: float = 0.0
) -> Concealed:
    """A wave over position; the first harmonic of another wave than a sine is all that a model could say of it."""
    first = amplitude * (8.0 / math.pi**2 if changes[_SHAPES[group]] == 1.0 else 1.0)
    rows = _rows(order, first, phase, second)
    return Concealed(changes, _first(rows), None if draw.other else {group: {"harmonics": rows}})


_SHAPES = {
    listed.POSITION_DEPENDENT_FRICTION: "grip_shape",
    listed.COGGING: "cogging_shape",
    listed.TORQUE_RIPPLE: "ripple_shape",
}


def _rows(order: float, amplitude: float, phase: float, second: float) -> list[Document]:
    rows = [{"amplitude": amplitude, "periods_per_turn": order, "phase": phase}]
    return rows + ([{"amplitude": second, "periods_per_turn": 2.0 * order, "phase": 2.0 * phase}] if second else [])


def _first(rows: list[Document]) -> dict[str, float]:
    return dict(rows[0])
