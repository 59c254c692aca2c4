"""Figures of an identification's friction: the Dahl curve with c0 (Fig. 7) and the friction-velocity map (Fig. 8).

Stands on the fits and the identified model; a known plant, where there is one, is drawn beside what was found.
"""

from __future__ import annotations

import numpy as np

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.identified import IdentifiedMap
from servod.lab.identify.fits.presliding import PreslidingFit
from servod.lab.report.figure import Array, Colour, Curve, Figure, PlotAxis, PlotPanel, ScaleKind, Style, array, curve
from servod.lab.verify.steady_friction import SteadyFriction, steady_friction

_POINTS = 400
MILLI = 1e3


def dahl_curve(found: PreslidingFit, truth: AxisModel | None = None, name: str = "dahl_curve") -> Figure:
    """Torque over displacement of one averaged presliding cycle, with the slope c0 and its 95 % interval.

    `truth` is the plant's model where it is known; its sigma0 is drawn as a slope beside.
    """
    way, torque = found.displacement_rad - found.displacement_rad.mean(), found.torque_nm
    c0, reach = found.stiffness, 1.08 * float(np.abs(torque).max())
    torques = np.array([-reach, reach])
    loop = np.append(np.arange(len(way)), 0)
    curves = [
        curve("measured, one averaged cycle", 1e6 * way[loop], MILLI * torque[loop], Colour.BLUE, width=1.8),
        _slope(f"c0 = {c0.value:.0f} N·m/rad (95 %: {c0.low:.0f} to {c0.high:.0f})", c0.value, torques, Colour.ORANGE),
        _slope("ends of the interval", c0.low, torques, Colour.ORANGE, Style.DOTTED),
        _slope("ends of the interval", c0.high, torques, Colour.ORANGE, Style.DOTTED),
    ]
    if truth is not None:
        known = steady_friction(truth).stiffness
        curves.append(_slope(f"plant, {known:.0f} N·m/rad", known, torques, Colour.GREEN, Style.DASHED))
    caption = (
        f"The slope at zero is c0; the loop leans by a factor of {found.bend:.3f} where it comes near break-away, "
        "which Dahl's law takes off."
    )
    panel = PlotPanel(PlotAxis("displacement in µrad"), PlotAxis("torque in mN·m"), tuple(curves))
    return Figure(name, "Dahl curve: torque over presliding displacement", (panel,), caption=caption, row_height=1.5)


def _slope(label: str, stiffness: float, torques: Array, colour: Colour, style: Style = Style.LINE) -> Curve:
    return curve(label, 1e6 * torques / stiffness, MILLI * torques, colour, style)


def friction_map(model: AxisModel, truth: AxisModel | None = None, name: str = "friction_map") -> Figure:
    """Friction over velocity, both directions with their 95 % intervals, signed and over the logarithm of speed.

    `model` is an identified one. Raises BadInput when it has no identified map.
    """
    if model.identified is None:
        raise BadInput("model: identified", "nothing", "a model that servoctl identify wrote")
    found = model.identified.friction_map
    known = None if truth is None else steady_friction(truth)
    signed = PlotPanel(
        PlotAxis("velocity in rad/s"), PlotAxis("friction in mN·m"), _map_curves(found, known, False), "signed"
    )
    by_speed = PlotPanel(
        PlotAxis("speed in rad/s", ScaleKind.LOG),
        PlotAxis("friction in mN·m"),
        _map_curves(found, known, True),
        "magnitude",
    )
    caption = "Bands are 95 % intervals; friction here is what the torque command must overcome, cogging taken off."
    return Figure(name, "Friction-velocity map", (signed, by_speed), 2, caption, 1.3)


def _map_curves(found: IdentifiedMap, known: SteadyFriction | None, by_speed: bool) -> tuple[Curve, ...]:
    curves = []
    for sign, colour in ((1.0, Colour.BLUE), (-1.0, Colour.ORANGE)):
        label = f"identified, {'positive' if sign > 0.0 else 'negative'} direction"
        velocity, torque, half = _side(found, sign)
        factor = sign if by_speed else 1.0
        bounds = tuple(sorted((factor * (torque - half), factor * (torque + half)), key=lambda b: float(b[0])))
        x, y = factor * velocity, MILLI * factor * torque
        curves.append(curve(label, x, y, colour, width=1.8, bounds=(MILLI * bounds[0], MILLI * bounds[1])))
        if known is not None:
            speeds = np.geomspace(np.abs(velocity).min(), np.abs(velocity).max(), _POINTS)
            truth = array([known.torque(sign * float(v)) for v in speeds])
            x, y = (speeds if by_speed else sign * speeds), MILLI * factor * truth
            curves.append(curve("plant", x, y, Colour.BLACK, Style.DASHED, 1.1))
    return tuple(curves)


def _side(found: IdentifiedMap, sign: float) -> tuple[Array, Array, Array]:
    """Velocities, torques and half widths of one direction."""
    velocity = array(found.velocities)
    here = velocity * sign > 0.0
    return velocity[here], array(found.torques)[here], array(found.half_widths)[here]
