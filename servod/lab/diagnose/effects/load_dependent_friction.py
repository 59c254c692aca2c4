"""Friction grows with what the gears carry."""

from __future__ import annotations

from dataclasses import replace

from servod.formats.model.friction import LoadDependentFriction
from servod.lab.diagnose.effects.effect import Effect, share, simple
from servod.lab.diagnose.effects.hypothesis import Term, get
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import SearchContext

#: Gears that lose more of the torque than this would hold themselves whatever drives them.
MOST_PER_COMMAND = 0.8

#: By which factor Coulomb friction may be another beside friction of the load.
LEVEL = 10.0


def terms(scene: SearchContext) -> list[Term]:
    """By the applied torque; by gravity and spring where the axis has them; by both; beside Coulomb's of another size.

    Friction under a load is partly load's and partly the model's own: who measured it once took both for one.
    """
    command = share("per_command", 0.0, 0.0, MOST_PER_COMMAND, 0.1)
    load = share("per_load", 0.0, 0.0, 2.0, 0.1)
    forms = {"applied torque": [command]}
    if any(get(known, "gravity.amplitude") > 0.0 or "spring" in known for known in (scene.document, scene.present)):
        forms |= {"load torque": [load], "both": [command, load]}
    found = [simple("load_dependent_friction", form, unknowns) for form, unknowns in forms.items()]
    own = get(scene.document, "friction.coulomb")
    if own <= 0.0 or get(scene.document, "friction.static") > 0.0:
        return found
    opens = {"friction.coulomb": (own / LEVEL, own * LEVEL)}
    another = [replace(term, form=f"{term.form}, another level", opens=opens) for term in found[:2]]
    return found + another


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
