"""Torque offset: a constant torque beside the command."""

from __future__ import annotations

from collections.abc import Sequence

from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, get
from servod.lab.diagnose.effects.scene import Scene


def _write(_document: Document, _values: Sequence[float]) -> None:
    """Nothing of its own: the term opens the bounds of the model's offset."""


def terms(scene: Scene) -> list[Term]:
    """The model's offset released."""
    most = 20.0 * max(scene.dry, scene.effort)

    def tell(document: Document, _values: Sequence[float]) -> list[Reported]:
        return [Reported("torque_offset", get(document, "torque_offset"), scene.force)]

    return [Term("torque_offset", "released", (), _write, tell, {"torque_offset": (-most, most)})]


EFFECT = Effect(
    name="torque_offset",
    group="torque_offset",
    equation="torque = command + torque_offset",
    source="current sensor offset, unbalanced hydraulic area, a constant weight on a linear axis",
    statement="A constant torque acts beside the command",
    shows="a mismatch that is the same at every position, speed and direction",
    confused=("asymmetry", "spring", "gravity", "disturbance"),
    experiment="rest at several positions, approached from both sides",
    terms=terms,
)
