"""Thermal: friction changes with temperature or time."""

from __future__ import annotations

from servod.diagnose.effects.effect import Effect, share, simple
from servod.diagnose.hypothesis import Term
from servod.diagnose.scene import Scene


def terms(scene: Scene) -> list[Term]:
    """By the recorded temperature where there is one, linear and exponential; by time otherwise."""
    found = []
    if scene.warm:
        rates = [share(key, 0.0, -0.5, 0.5, 0.05, "1/°C") for key in ("dry_per_c", "viscous_per_c")]
        found.append(simple("thermal", "temperature", rates, shape="exponential"))
        found.append(simple("thermal", "temperature, straight", rates, shape="linear"))
    length = max(scene.duration_s, 1e-3)
    drifts = [
        share(key, 0.0, -3.0 / length, 3.0 / length, 0.3 / length, "1/s") for key in ("dry_per_s", "viscous_per_s")
    ]
    return [*found, simple("thermal", "drift", drifts)]


EFFECT = Effect(
    name="thermal",
    group="thermal",
    equation="dry and viscous friction times 1 + k*(T - reference_c), exp(k*(T - reference_c)) or 1 + k_t*t",
    source="Bittencourt and Gunnarsson, ASME JDSMC 134(5), 2012; Simoni et al., IROS 2015",
    statement="Friction changes as the joint warms up or as time passes",
    shows="a mismatch opposed to the motion that drifts over the recording or from one recording to the next",
    confused=("viscous_nonlinear", "load_dependent_friction", "stribeck"),
    experiment="the same motion cold and warm",
    terms=terms,
)
