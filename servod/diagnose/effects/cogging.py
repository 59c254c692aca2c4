"""Cogging: a torque over position, periodic, whatever the command."""

from __future__ import annotations

import numpy as np

from servod.diagnose.effects.effect import Effect, sine_term
from servod.diagnose.hypothesis import Term
from servod.diagnose.scene import Scene


def terms(scene: Scene) -> list[Term]:
    """Sines whose period is searched, and with the second harmonic."""
    peaks = scene.peaks(scene.carried(-np.ones_like(scene.position)), 3)
    most = 20.0 * max(scene.dry, 0.05 * scene.effort)
    found = [sine_term("cogging", scene, peak, scene.dry, scene.force, most=most) for peak in peaks]
    return [*found, sine_term("cogging", scene, peaks[0], scene.dry, scene.force, most=most, multiples=2)]


EFFECT = Effect(
    name="cogging",
    group="cogging",
    equation="resisting torque += sum amplitude*sin(n*x + phase)",
    source="Hanselman, Brushless Permanent Magnet Motor Design, 2003",
    statement="A torque that repeats along the way acts whatever the command is: cogging",
    shows="a mismatch periodic in position, the same in both directions and at every command",
    confused=("torque_ripple", "encoder_eccentricity", "gravity", "spring", "position_dependent_friction"),
    experiment="slow passes in both directions with different loads: what stays the same is cogging",
    terms=terms,
)
