"""Asymmetry: friction differs by direction."""

from __future__ import annotations

from collections.abc import Sequence

from servod.diagnose.effects.effect import Effect, share
from servod.diagnose.hypothesis import Document, Reported, Term
from servod.diagnose.scene import Scene


def _write(document: Document, values: Sequence[float]) -> None:
    dry, viscous = values[0], values[1] if len(values) > 1 else values[0]
    document["asymmetry"] = {
        "positive_dry": 1.0 + dry,
        "negative_dry": 1.0 - dry,
        "positive_viscous": 1.0 + viscous,
        "negative_viscous": 1.0 - viscous,
    }


def _write_dry(document: Document, values: Sequence[float]) -> None:
    _write(document, (values[0], 0.0))


def _tell(document: Document, values: Sequence[float]) -> list[Reported]:
    """The ratio of friction for v < 0 to that for v > 0, and the factors themselves."""
    written: Document = {}
    (_write if len(values) > 1 else _write_dry)(written, values)
    found = [Reported("negative_over_positive", (1.0 - values[0]) / (1.0 + values[0]), "1")]
    return found + [Reported(key, value, "1") for key, value in written["asymmetry"].items()]


def terms(scene: Scene) -> list[Term]:
    """Dry friction by direction; dry and viscous friction each by direction; both by the same factor."""
    dry = share("dry", 0.0, -0.9, 0.9, 1.0)
    viscous = share("viscous", 0.0, -0.9, 0.9, 1.0)
    return [
        Term("asymmetry", "both", (dry, viscous), _write, _tell),
        Term("asymmetry", "dry", (dry,), _write_dry, _tell),
    ]


EFFECT = Effect(
    name="asymmetry",
    group="asymmetry",
    equation="g(v) -> k(sign v)*g(v),  F_v -> k_v(sign v)*F_v",
    source="Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994; maps signed per direction",
    statement="Friction differs by direction",
    shows="a step of the mismatch where the velocity changes sign, the same at every position and load",
    confused=("torque_offset", "torque_gain", "spring"),
    experiment="constant speeds in both directions over the same range: half the difference of the torques",
    terms=terms,
)
