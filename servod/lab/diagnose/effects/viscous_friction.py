"""Viscous friction: the level of the model's own is off, or it has none and the axis has some."""

from __future__ import annotations

from collections.abc import Sequence

from servod.lab.diagnose.effects.base import LEVEL_SHARE, off_by_share
from servod.lab.diagnose.effects.effect import ANOTHER_DRIVE, Effect, level, map_level
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, Unknown, get, put
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

KEY = "friction.viscous"

#: Where the model has none: so many times dry friction at high speed, at most.
MOST = 20.0


def terms(scene: SearchContext) -> list[Term]:
    """One factor on the model's own; where that has none, the coefficient itself."""
    nominal, unit = get(scene.document, KEY), f"{scene.force}·s/{scene.length}"
    if scene.document["friction"]["kind"] == "local":
        return [map_level("viscous_friction", dry=False)] if nominal > 0.0 else []

    def report(document: Document, _values: Sequence[float]) -> list[Reported]:
        found = get(document, KEY)
        over = [Reported("over_model", found / nominal, "1")] if nominal > 0.0 else []
        return [Reported("viscous", found, unit), *over]

    if nominal > 0.0:
        return [level("viscous_friction", scene.document, (KEY,), report)]
    size = scene.dry / scene.speed
    return [Term("viscous_friction", "new", (Unknown("viscous", unit, 0.0, 0.0, MOST * size, size),), _write, report)]


def _write(document: Document, values: Sequence[float]) -> None:
    put(document, KEY, values[0])


def _at_level(nominal: Document, fitted: Document) -> bool:
    return off_by_share(nominal, fitted, KEY) >= LEVEL_SHARE


EFFECT = Effect(
    name="viscous_friction",
    group=None,
    equation="F_v -> factor*F_v",
    source="viscosity of grease over temperature and age; Bittencourt and Gunnarsson, ASME JDSMC 134(5), 2012",
    statement="Viscous friction is not the model's: its level is off",
    shows="a mismatch opposed to the motion that grows in a straight line with speed",
    confused=("viscous_nonlinear", "thermal", "torque_gain", "dry_friction"),
    experiment="constant speeds from slow to the fastest, in both directions, cold and warm",
    terms=terms,
    look=Look("velocity"),
    friction_keys=("viscous",),
    far=True,
    jointly=True,
    one_with=ANOTHER_DRIVE,
    within=("asymmetry",),
    at_level=_at_level,
)
