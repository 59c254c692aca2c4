"""Inertia: more or less mass moves than the model says."""

from __future__ import annotations

from collections.abc import Sequence

from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, get
from servod.lab.diagnose.effects.scene import Scene


def _write(_document: Document, _values: Sequence[float]) -> None:
    """Nothing of its own: the term opens the bounds of the model's inertia."""


def terms(scene: Scene) -> list[Term]:
    """The model's inertia released."""
    unit = "kg" if scene.linear else "kg·m²"

    def tell(document: Document, _values: Sequence[float]) -> list[Reported]:
        return [Reported("inertia", get(document, "inertia"), unit)]

    return [Term("inertia", "released", (), _write, tell, {"inertia": (0.05 * scene.inertia, 20.0 * scene.inertia)})]


EFFECT = Effect(
    name="inertia",
    group="inertia",
    equation="inertia*a = torque - friction - load",
    source="Newton",
    statement="More or less mass moves than the model says: the inertia is off",
    shows="a mismatch in proportion to the acceleration",
    confused=("torque_gain", "joint_elasticity", "actuator_lag"),
    experiment="fast reversals with and without a known mass",
    terms=terms,
    far=True,
)
