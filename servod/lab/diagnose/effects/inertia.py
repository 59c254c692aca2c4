"""Inertia: more or less mass moves than the model says."""

from __future__ import annotations

from collections.abc import Sequence

from servod.lab.diagnose.effects.base import RECALIBRATION, factor
from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, get
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext


def _write(_document: Document, _values: Sequence[float]) -> None:
    """Nothing of its own: the term opens the bounds of the model's inertia."""


def terms(scene: SearchContext) -> list[Term]:
    """The model's inertia released."""
    unit = "kg" if scene.linear else "kg·m²"

    def report(document: Document, _values: Sequence[float]) -> list[Reported]:
        return [Reported("inertia", get(document, "inertia"), unit)]

    return [Term("inertia", "released", (), _write, report, {"inertia": (0.05 * scene.inertia, 20.0 * scene.inertia)})]


def _at_level(nominal: Document, fitted: Document) -> bool:
    return factor(nominal, fitted, "inertia") >= 1.0 + RECALIBRATION


EFFECT = Effect(
    name="inertia",
    group=None,
    equation="inertia*a = torque - friction - load",
    source="Newton",
    statement="More or less mass moves than the model says: the inertia is off",
    shows="a mismatch in proportion to the acceleration",
    confused=("torque_gain", "joint_elasticity", "actuator_lag"),
    experiment="fast reversals with and without a known mass",
    terms=terms,
    look=Look("acceleration"),
    far=True,
    jointly=True,
    swift=True,
    at_level=_at_level,
)
