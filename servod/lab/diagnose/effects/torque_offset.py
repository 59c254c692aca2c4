"""Torque offset: a constant torque beside the command."""

from __future__ import annotations

from collections.abc import Sequence

from servod.lab.diagnose.effects.base import OFFSET_SHARE
from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, get
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext


def _write(_document: Document, _values: Sequence[float]) -> None:
    """Nothing of its own: the term opens the bounds of the model's offset."""


def terms(scene: SearchContext) -> list[Term]:
    """The model's offset released."""
    most = 20.0 * max(scene.dry, scene.effort)

    def report(document: Document, _values: Sequence[float]) -> list[Reported]:
        return [Reported("torque_offset", get(document, "torque_offset"), scene.force)]

    return [Term("torque_offset", "released", (), _write, report, {"torque_offset": (-most, most)})]


def _at_level(nominal: Document, fitted: Document) -> bool:
    off = abs(get(fitted, "torque_offset") - get(nominal, "torque_offset"))
    return off >= OFFSET_SHARE * get(nominal, "friction.coulomb")


EFFECT = Effect(
    name="torque_offset",
    group=None,
    equation="torque = command + torque_offset",
    source="current sensor offset, unbalanced hydraulic area, a constant weight on a linear axis",
    statement="A constant torque acts beside the command",
    shows="a mismatch that is the same at every position, speed and direction",
    confused=("asymmetry", "spring", "gravity", "disturbance"),
    experiment="rest at several positions, approached from both sides",
    terms=terms,
    look=Look("time"),
    directed=True,
    within=("spring",),
    at_level=_at_level,
)
