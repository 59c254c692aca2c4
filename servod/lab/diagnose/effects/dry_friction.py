"""Dry friction: the level of the model's own, Coulomb and static friction alike, is off."""

from __future__ import annotations

from collections.abc import Sequence

from servod.lab.diagnose.effects.base import LEVEL_SHARE, dry_nm
from servod.lab.diagnose.effects.effect import ANOTHER_DRIVE, Effect, level, map_level
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, get
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: What the factor is on: the curve keeps its shape.
SCALES = ("friction.coulomb", "friction.static")


def terms(scene: SearchContext) -> list[Term]:
    """One factor on all dry friction, or on the dry part of a map."""
    if scene.document["friction"]["kind"] == "local":
        return [map_level("dry_friction", dry=True)]
    nominal = get(scene.document, "friction.coulomb")
    if nominal <= 0.0:
        return []

    def report(document: Document, _values: Sequence[float]) -> list[Reported]:
        found = get(document, "friction.coulomb")
        return [Reported("coulomb", found, scene.force), Reported("over_model", found / nominal, "1")]

    return [level("dry_friction", scene.document, SCALES, report)]


def _at_level(nominal: Document, fitted: Document) -> bool:
    was = dry_nm(nominal)
    return was > 0.0 and abs(dry_nm(fitted) - was) >= LEVEL_SHARE * was


EFFECT = Effect(
    name="dry_friction",
    group=None,
    equation="g(v) -> factor*g(v): Coulomb and static friction by the same factor",
    source="levels of friction differ between joints of one kind, with grease, seals, preload and age",
    statement="Dry friction is not the model's: its level is off",
    shows="a step of the mismatch where the velocity changes sign, as high at every speed",
    confused=("thermal", "torque_gain", "load_dependent_friction", "viscous_friction"),
    experiment="constant speeds from slow to fast in both directions, cold and warm",
    terms=terms,
    look=Look("velocity"),
    friction_keys=("coulomb", "static"),
    far=True,
    jointly=True,
    one_with=ANOTHER_DRIVE,
    within=("asymmetry",),
    at_level=_at_level,
)
