"""Friction grows with what the gears carry."""

from __future__ import annotations

from servod.formats.model.friction import LoadDependentFriction
from servod.lab.diagnose.effects.effect import Effect, share, simple
from servod.lab.diagnose.effects.hypothesis import Term, get
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import SearchContext


def terms(scene: SearchContext) -> list[Term]:
    """By the applied torque; by gravity and spring where the model has them; by both."""
    command = share("per_command", 0.0, 0.0, 2.0, 0.1)
    load = share("per_load", 0.0, 0.0, 2.0, 0.1)
    found = [simple("load_dependent_friction", "applied torque", [command])]
    if get(scene.document, "gravity.amplitude") > 0.0 or "spring" in scene.document:
        found.append(simple("load_dependent_friction", "load torque", [load]))
        found.append(simple("load_dependent_friction", "both", [command, load]))
    return found


EFFECT = Effect(
    name="load_dependent_friction",
    group=LoadDependentFriction,
    equation="g -> g + per_command*|torque| + per_load*|load torque|",
    source="Hamon, Gautier, Garrec, IROS 2010; Duclusaud et al. (BAM), 2024",
    statement="Dry friction grows with the torque that the transmission carries",
    shows="a mismatch opposed to the motion, in proportion to the torque, at all positions",
    confused=("position_dependent_friction", "torque_gain", "viscous_nonlinear"),
    experiment="the same slow motion with and without a weight, or at accelerations of both signs",
    terms=terms,
    look=Look("load", Split.DIRECTION),
    swift=True,
)
