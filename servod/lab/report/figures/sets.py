"""Figures of the local sets: their weighting functions (Fig. 2), and the friction that they make together.

Stands on the law's own interpolation (servod.kernels.laws.weights), so what is drawn is what runs.
"""

from __future__ import annotations

import numpy as np

from servod.common.errors import BadInput
from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters
from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws.weights import Shape, blended, weights
from servod.lab.report.figure import (
    COLOURS,
    Array,
    Colour,
    Curve,
    Figure,
    PlotAxis,
    PlotPanel,
    ScaleKind,
    Style,
    array,
    curve,
)
from servod.lab.verify.steady_friction import SteadyFriction, steady_friction

_POINTS = 1200
_LEGEND = 10  # so many sets have room in a legend
MILLI = 1e3


def local_law(gains: GainSet) -> LocalParameters:
    """The parameters of the local law. Raises BadInput when the set is for another law."""
    if not isinstance(gains.parameters, LocalParameters):
        raise BadInput(f"gain set {gains.name}: parameters.law", gains.parameters.law, "local")
    return gains.parameters


def weighting_functions(gains: GainSet, name: str = "weighting_functions") -> Figure:
    """The weights mu_i of all local sets over the velocity (Fig. 2): the whole range, and around zero."""
    law = local_law(gains)
    nodes = [s.velocity_rad_s for s in law.friction.sets]
    near = sorted(abs(v) for v in nodes)[min(4, len(nodes) - 1)]
    panels = tuple(
        PlotPanel(
            PlotAxis("velocity in rad/s", span=(-reach, reach)), PlotAxis("weight μ_i"), _weights(law, reach), title
        )
        for title, reach in (("whole range", 1.05 * max(map(abs, nodes))), ("around zero", 1.3 * near))
    )
    caption = f"{len(nodes)} local sets, shape {law.friction.weights.value}; at every velocity the weights sum to one."
    return Figure(name, "Weighting functions of the local sets", panels, 2, caption, 1.1)


def _weights(law: LocalParameters, reach: float) -> tuple[Curve, ...]:
    """The weights within `reach` of zero; named by their node where the legend has room for all of them."""
    nodes = [s.velocity_rad_s for s in law.friction.sets]
    velocity = np.unique(np.concatenate([np.linspace(-reach, reach, _POINTS), [v for v in nodes if abs(v) < reach]]))
    share = weight_table(law, velocity)
    return tuple(
        curve(
            f"v_i = {v:g}" if len(nodes) <= _LEGEND else "",
            velocity,
            share[:, i],
            COLOURS[i % len(COLOURS)],
            Style.LINE if i < len(COLOURS) else Style.DASHED,
            detail=f"v_i = {v:g} rad/s",
        )
        for i, v in enumerate(nodes)
    )


def weight_table(law: LocalParameters, velocity: Array) -> Array:
    """mu_i for each velocity (rows) and each set (columns)."""
    nodes = [s.velocity_rad_s for s in law.friction.sets]
    shape = Shape[law.friction.weights.name]
    return array([weights(shape, nodes, float(v)) for v in velocity])


def steady_compensation(law: LocalParameters, velocity: Array) -> Array:
    """Torque in N*m that the compensator settles to at each velocity: c0*v/a(v) + d0*v, within its bound."""
    friction, p = law.friction, law.named()
    decay = array([max(blended(p.sets, p.shape, float(v))[0], p.leak) for v in velocity])
    bristle = np.clip(friction.stiffness_nm_per_rad * velocity / decay, -friction.friction_limit_nm, None)
    held: Array = np.minimum(bristle, friction.friction_limit_nm) + friction.viscous_nms_per_rad * velocity
    return held


def local_friction(gains: GainSet, model: AxisModel | None = None, name: str = "local_friction") -> Figure:
    """Steady friction of the sets against the map they were made from, and their difference as a share.

    `model` defaults to the one in the set's design. Raises BadInput when there is neither.
    """
    law = local_law(gains)
    if model is None and gains.design is None:
        raise BadInput(f"gain set {gains.name}: design", "nothing", "a design, or a model beside it")
    friction = steady_friction(model or gains.design.model)  # type: ignore[union-attr]
    nodes = array([s.velocity_rad_s for s in law.friction.sets])
    force, deviation = [], []
    for sign, colour in ((1.0, Colour.BLUE), (-1.0, Colour.ORANGE)):
        upper, lower = _direction(law, friction, nodes[sign * nodes > 0.0], sign, colour)
        force += upper
        deviation.append(lower)
    x = PlotAxis("speed in rad/s", ScaleKind.LOG)
    panels = (
        PlotPanel(x, PlotAxis("friction in mN·m"), tuple(force), "steady friction, law and map"),
        PlotPanel(x, PlotAxis("law minus map in %"), tuple(deviation), "difference"),
    )
    caption = f"{len(nodes)} local sets, a_i by (7) in each direction; the law's own interpolation runs between them."
    return Figure(name, "Friction of the local sets", panels, 2, caption, 1.2)


def _direction(
    law: LocalParameters, friction: SteadyFriction, nodes: Array, sign: float, colour: Colour
) -> tuple[list[Curve], Curve]:
    """(map, law and nodes over speed; their difference in per cent) of one direction."""
    speeds = np.geomspace(0.5 * np.abs(nodes).min(), np.abs(nodes).max(), _POINTS // 2)
    truth = array([abs(friction.torque(sign * float(v))) for v in speeds])
    law_nm = np.abs(steady_compensation(law, sign * speeds))
    side = "positive" if sign > 0.0 else "negative"
    at_nodes = np.abs(steady_compensation(law, nodes))
    return [
        curve(f"law, {side}", speeds, MILLI * law_nm, colour, width=1.8),
        curve("local sets", np.abs(nodes), MILLI * at_nodes, colour, Style.POINTS),
        curve("map", speeds, MILLI * truth, Colour.BLACK, Style.DASHED, 1.1),
    ], curve(f"law, {side}", speeds, 100.0 * (law_nm / truth - 1.0), colour, width=1.8)
