"""Presliding: the bristle's stiffness and damping are not the model's."""

from __future__ import annotations

from servod.diagnose.effects.effect import Effect, positive, simple
from servod.diagnose.hypothesis import Term, get
from servod.diagnose.scene import Scene


def terms(scene: Scene) -> list[Term]:
    """The bristle of the model released, softer and stiffer; a bristle where the model has none; fading damping."""
    own = get(scene.document, "friction.sigma0")
    damping = get(scene.document, "friction.sigma1")
    starts = [own, own / 5.0, own * 5.0] if own > 0.0 else [scene.dry / (f * scene.reach) for f in (1e-4, 1e-3, 1e-2)]
    found = []
    for stiffness in starts:
        fair = damping if damping > 0.0 else 0.3 * (stiffness * scene.inertia) ** 0.5
        bristle = [
            positive("sigma0", f"{scene.force}/{scene.length}", stiffness),
            positive("sigma1", f"{scene.force}·s/{scene.length}", fair),
        ]
        found.append(simple("presliding", "bristle", bristle))
    fading = positive("damping_velocity", f"{scene.length}/s", 0.1 * scene.speed, 100.0)
    found.append(simple("presliding", "fading damping", [*bristle[:1], bristle[1], fading]))
    return found


EFFECT = Effect(
    name="presliding",
    group="presliding",
    equation="dz/dt = v - sigma0*|v|/g(v)*z,  F = sigma0*z + sigma1(v)*dz/dt",
    source="Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE TAC 40(3), 1995; Olsson 1996",
    statement="Before it slides the joint gives way like a spring of another stiffness or damping than the model's",
    shows="a mismatch within a short way behind each reversal and at rest",
    confused=("stribeck", "joint_elasticity", "backlash", "delay"),
    experiment="small slow forces below breakaway, up and down: the hysteresis loop",
    terms=terms,
    far=True,
)
