"""Presliding: the bristle's stiffness and damping are not the model's."""

from __future__ import annotations

from collections.abc import Sequence

from servod.formats.model.friction import Presliding
from servod.lab.diagnose.effects.base import BRISTLE_FACTOR, factor
from servod.lab.diagnose.effects.effect import Effect, keys, positive, simple
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Reporter, Term, Unknown, get
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import SearchContext

#: Factors on the model's own stiffness and damping to start from, and by which they may be off.
STARTS, MOST = ((0.25, 0.5), (4.0, 2.0), (1.0, 5.0), (1.0, 0.2)), 300.0

#: Without a bristle in the model: ways to break away to start from, as shares of the range.
WAYS = (1e-4, 1e-3, 1e-2)


def _reporter(scene: SearchContext) -> Reporter:
    units = {"sigma0": f"{scene.force}/{scene.length}", "sigma1": f"{scene.force}·s/{scene.length}"}

    def report(document: Document, values: Sequence[float]) -> list[Reported]:
        found = [Reported(key, get(document, f"friction.{key}"), unit) for key, unit in units.items()]
        return found + [Reported("damping_velocity", value, f"{scene.length}/s") for value in values]

    return report


def terms(scene: SearchContext) -> list[Term]:
    """The bristle of the model released, from where it stands, softer and stiffer; a new one; fading damping.

    No new one where a servo's loop makes the torque: so soft a bristle is what its delay leaves.
    """
    own, damping = get(scene.document, "friction.sigma0"), get(scene.document, "friction.sigma1")
    if own <= 0.0 and scene.servo:
        return []
    if own <= 0.0:
        return [_new(scene, scene.dry / (way * scene.reach)) for way in WAYS]
    opens = {"friction.sigma0": (own / MOST, own * MOST)}
    opens |= {"friction.sigma1": (damping / MOST, damping * MOST)} if damping > 0.0 else {}
    starts = STARTS if damping > 0.0 else STARTS[:2]
    begins = [{"friction.sigma0": stiff * own, "friction.sigma1": damped * damping} for stiff, damped in starts]
    found = [
        Term("presliding", "bristle", (), lambda _d, _v: None, _reporter(scene), opens, begin)
        for begin in ({}, *begins)
    ]
    fading = Unknown("damping_velocity", f"{scene.length}/s", 0.1 * scene.speed, 1e-4 * scene.speed, 10.0 * scene.speed)
    write = keys("presliding", ["damping_velocity"])
    return [*found, Term("presliding", "fading damping", (fading,), write, _reporter(scene), opens)]


def _new(scene: SearchContext, stiffness: float) -> Term:
    """A bristle for a model without one."""
    unknowns = [
        positive("sigma0", f"{scene.force}/{scene.length}", stiffness),
        positive("sigma1", f"{scene.force}·s/{scene.length}", 0.3 * (stiffness * scene.inertia) ** 0.5),
    ]
    return simple("presliding", "bristle", unknowns)


def _at_level(nominal: Document, fitted: Document) -> bool:
    """A bristle that the model has must be off by a factor; a new one, or damping that fades, has no level."""
    if get(nominal, "friction.sigma0") <= 0.0 or "presliding" in fitted:
        return True
    return max(factor(nominal, fitted, f"friction.{key}") for key in ("sigma0", "sigma1")) >= BRISTLE_FACTOR


EFFECT = Effect(
    name="presliding",
    group=Presliding,
    equation="dz/dt = v - sigma0*|v|/g(v)*z,  F = sigma0*z + sigma1(v)*dz/dt",
    source="Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE TAC 40(3), 1995; Olsson 1996",
    statement="Before it slides the joint gives way like a spring of another stiffness or damping than the model's",
    shows="a mismatch within a short way behind each reversal and at rest",
    confused=("stribeck", "joint_elasticity", "backlash", "delay"),
    experiment="small slow forces below breakaway, up and down: the hysteresis loop",
    terms=terms,
    look=Look("time since reversal", Split.DIRECTION),
    friction_keys=("sigma0", "sigma1"),
    far=True,
    at_level=_at_level,
)
