"""Inertia that changes along the way."""

from __future__ import annotations

import math

from servod.formats.model.effects import PositionDependentInertia
from servod.lab.diagnose.effects.effect import Effect, sine_term
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import Peak, SearchContext


def terms(scene: SearchContext) -> list[Term]:
    """One and two periods in a turn (one in the range on a linear axis), and a searched order."""
    effect = "position_dependent_inertia"
    peaks = scene.peaks(scene.carried(-scene.inertia * scene.acceleration), 1)
    found = [sine_term(effect, scene, peak, 0.2, "1", most=0.65) for peak in peaks]
    low = [2.0 * math.pi / scene.reach] if scene.linear else scene.low_orders(1.0, 2.0, 3.0)
    fixed = [sine_term(effect, scene, Peak(n, 0.0, 0.0, 0.0), 0.2, "1", most=0.65, free=False) for n in low]
    return fixed + found


EFFECT = Effect(
    name="position_dependent_inertia",
    group=PositionDependentInertia,
    equation="M(x)*a + M'(x)*v^2/2 = torque,  M(x) = inertia*(1 + sum amplitude*sin(n*x + phase))",
    source="Lagrange's equation of a linkage, crank or eccentric load",
    statement="The inertia changes along the way",
    shows="a mismatch in proportion to the acceleration, with a sign that depends on the position",
    confused=("encoder_eccentricity", "torque_ripple", "gravity"),
    experiment="the same fast reversal at several positions",
    terms=terms,
    look=Look("position", Split.LOAD),
    swift=True,
    repeatable=True,
    soaks_up=True,
)
