"""Stribeck: friction falls from static to Coulomb as the joint starts to slide."""

from __future__ import annotations

from collections.abc import Sequence

from servod.diagnose.effects.effect import Effect, share
from servod.diagnose.hypothesis import Document, Reported, Teller, Term, Unknown, get
from servod.diagnose.scene import Scene


def _write(document: Document, values: Sequence[float]) -> None:
    group = document.setdefault("stribeck", {})
    group["static"] = max(get(document, "friction.coulomb") * (1.0 + values[0]), 1e-9)
    group["stribeck_velocity"] = values[1]
    if len(values) > 2:
        group["exponent"] = values[2]


def _tell(scene: Scene) -> Teller:
    def tell(document: Document, values: Sequence[float]) -> list[Reported]:
        found = [
            Reported("static", get(document, "friction.coulomb") * (1.0 + values[0]), scene.force),
            Reported("stribeck_velocity", values[1], f"{scene.length}/s"),
        ]
        return found + [Reported("exponent", value, "1") for value in values[2:]]

    return tell


def terms(scene: Scene) -> list[Term]:
    """The curve with the paper's exponent from some velocities, and one with a free exponent."""
    if get(scene.document, "friction.coulomb") <= 0.0:
        return []
    coulomb = get(scene.document, "friction.coulomb")
    own = get(scene.document, "friction.static", coulomb) / coulomb - 1.0
    excess = share("excess", own + 0.1, -0.6, 6.0, 1.0)
    tell = _tell(scene)
    found = []
    for speed in (get(scene.document, "friction.stribeck_velocity", 0.1 * scene.speed), 0.03 * scene.speed):
        velocity = Unknown("velocity", f"{scene.length}/s", speed, 1e-3 * scene.speed, 1.0 * scene.speed)
        found.append(Term("stribeck", "gauss", (excess, velocity), _write, tell))
    exponent = Unknown("exponent", "1", 1.0, 0.4, 4.0)
    found.append(Term("stribeck", "free exponent", (excess, velocity, exponent), _write, tell))
    return found


EFFECT = Effect(
    name="stribeck",
    group="stribeck",
    equation="g(v) = F_C + (F_S - F_C)*exp(-(|v|/v_s)^exponent)",
    source="Stribeck 1902; Bo and Pavelescu, Wear 82, 1982 (exponent); the paper's (18)",
    statement="At low speed friction is not the model's: the Stribeck curve from static to sliding friction differs",
    shows="a mismatch at the lowest speeds, opposed to the motion, gone above some Stribeck velocities",
    confused=("presliding", "viscous_nonlinear", "thermal"),
    experiment="slow constant speeds on both sides of the Stribeck velocity, and breakaway ramps",
    terms=terms,
    far=True,
)
