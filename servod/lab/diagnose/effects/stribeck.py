"""Stribeck: friction falls from static to Coulomb as the joint starts to slide."""

from __future__ import annotations

from collections.abc import Sequence

from servod.formats.model.friction import Stribeck
from servod.lab.diagnose.effects.base import STRIBECK_SHARE
from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Reporter, Term, Unknown, get, put
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Static friction to start from, as a multiple of Coulomb friction.
START = 1.4


def _reporter(scene: SearchContext) -> Reporter:
    def report(document: Document, _values: Sequence[float]) -> list[Reported]:
        found = []
        for key, unit in (("static", scene.force), ("stribeck_velocity", f"{scene.length}/s"), ("exponent", "1")):
            value = get(document, f"stribeck.{key}") or get(document, f"friction.{key}")
            found += [Reported(key, value, unit)] if value else []
        return found

    return report


def _exponent(document: Document, values: Sequence[float]) -> None:
    put(document, "stribeck.exponent", values[-1])


def _whole(document: Document, values: Sequence[float]) -> None:
    """The whole curve in its own group, for a model whose friction has none."""
    static = get(document, "friction.coulomb") * (1.0 + values[0])
    document["stribeck"] = {"static": static, "stribeck_velocity": values[1]}


def terms(scene: SearchContext) -> list[Term]:
    """The curve with the paper's exponent, from where it stands and from some velocities; one with a free exponent."""
    coulomb = get(scene.document, "friction.coulomb")
    if coulomb <= 0.0:
        return []
    own = get(scene.document, "friction.stribeck_velocity", 0.05 * scene.speed)
    speeds = (own, 0.02 * scene.speed)
    unit = f"{scene.length}/s"
    if get(scene.document, "friction.static") <= 0.0:
        excess = Unknown("excess", "1", START - 1.0, -0.8, 10.0, 1.0)
        curves = [(excess, Unknown("velocity", unit, v, 1e-4 * scene.speed, scene.speed)) for v in speeds]
        return [Term("stribeck", "gauss", curve, _whole, _reporter(scene)) for curve in curves]
    opens = {
        "friction.static": (0.2 * coulomb, 10.0 * coulomb),
        "friction.stribeck_velocity": (1e-4 * scene.speed, scene.speed),
    }
    begins = [{"friction.static": START * coulomb, "friction.stribeck_velocity": v} for v in speeds]
    found = [
        Term("stribeck", "gauss", (), lambda _d, _v: None, _reporter(scene), opens, begin) for begin in ({}, *begins)
    ]
    free = Unknown("exponent", "1", 1.0, 0.4, 4.0)
    return [*found, Term("stribeck", "free exponent", (free,), _exponent, _reporter(scene), opens, begins[0])]


def _at_level(nominal: Document, fitted: Document) -> bool:
    """The model's own curve must rise by a share of Coulomb friction; another curve has no level.

    What a factor on all dry friction makes of its rise is that of `dry_friction`.
    """
    if "stribeck" in fitted:
        return True
    was, now = ((get(d, "friction.static"), get(d, "friction.coulomb")) for d in (nominal, fitted))
    level = now[1] / was[1]
    return abs(now[0] - now[1] - level * (was[0] - was[1])) >= STRIBECK_SHARE * level * was[1]


EFFECT = Effect(
    name="stribeck",
    group=Stribeck,
    equation="g(v) = F_C + (F_S - F_C)*exp(-(|v|/v_s)^exponent)",
    source="Stribeck 1902; Bo and Pavelescu, Wear 82, 1982 (exponent); the paper's (18)",
    statement="At low speed friction is not the model's: the Stribeck curve from static to sliding friction differs",
    shows="a mismatch at the lowest speeds, opposed to the motion, gone above some Stribeck velocities",
    confused=("presliding", "viscous_nonlinear", "thermal"),
    experiment="slow constant speeds on both sides of the Stribeck velocity, and breakaway ramps",
    terms=terms,
    look=Look("velocity"),
    friction_keys=("static", "stribeck_velocity"),
    far=True,
    at_level=_at_level,
)
