"""Viscous friction that is not a straight line of velocity."""

from __future__ import annotations

from servod.formats.model.friction import ViscousNonlinear
from servod.lab.diagnose.effects.effect import Effect, share, simple
from servod.lab.diagnose.effects.hypothesis import Term, Unknown
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Bound of the terms: so many times the model's own viscous torque, or dry friction, at high speed.
MOST = 20.0


def terms(scene: SearchContext) -> list[Term]:
    """A quadratic, a cubic, both, and a power that thins out."""
    speed = scene.speed
    torque = max(scene.viscous * speed, scene.dry)
    unit = f"{scene.force}·(s/{scene.length})"
    quadratic = share(
        "quadratic", 0.0, -MOST * torque / speed**2, MOST * torque / speed**2, torque / speed**2, unit + "²"
    )
    cubic = share("cubic", 0.0, -MOST * torque / speed**3, MOST * torque / speed**3, torque / speed**3, unit + "³")
    exponent = Unknown("exponent", "1", 0.5, 0.15, 0.9)
    size = torque / speed**0.5
    power = share("power", 0.1 * size, -MOST * size, MOST * size, size, unit + "^exponent")
    return [
        simple("viscous_nonlinear", "quadratic", [quadratic]),
        simple("viscous_nonlinear", "cubic", [cubic]),
        simple("viscous_nonlinear", "quadratic and cubic", [quadratic, cubic]),
        simple("viscous_nonlinear", "power", [power, exponent]),
    ]


EFFECT = Effect(
    name="viscous_nonlinear",
    group=ViscousNonlinear,
    equation="F += quadratic*|v|*v + cubic*v^3 + power*sign(v)*|v|^exponent",
    source="churning losses (quadratic), thinning greases (exponent < 1); Kermani et al., IEEE TCST 15(3), 2007",
    statement="Viscous friction does not grow in a straight line with speed",
    shows="a mismatch opposed to the motion that bends over speed, the same in both directions",
    confused=("torque_saturation", "stribeck", "thermal"),
    experiment="constant speeds from slow to the fastest, in both directions",
    terms=terms,
    look=Look("velocity"),
    swift=True,
)
