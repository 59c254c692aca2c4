"""Torque gain: the drive makes more or less torque of a command than it says."""

from __future__ import annotations

from servod.formats.model.effects import TorqueGain
from servod.lab.diagnose.effects.base import DRIVE_SCALES, RECALIBRATION
from servod.lab.diagnose.effects.effect import Effect, positive, simple
from servod.lab.diagnose.effects.hypothesis import Document, Term, get
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext


def terms(scene: SearchContext) -> list[Term]:
    """One factor, and one for each sign of the command."""
    factors = [positive("factor", "1", 1.0, 5.0), positive("negative_factor", "1", 1.0, 5.0)]
    return [simple("torque_gain", "one factor", factors[:1]), simple("torque_gain", "by sign", factors)]


def _at_level(_nominal: Document, fitted: Document) -> bool:
    factors = [get(fitted, f"torque_gain.{key}", 1.0) for key in ("factor", "negative_factor")]
    return max(max(f, 1.0 / f) for f in factors) >= 1.0 + RECALIBRATION


EFFECT = Effect(
    name="torque_gain",
    group=TorqueGain,
    equation="torque = factor*command (negative_factor*command for negative commands)",
    source="torque constant, gear ratio or current scale that is not what the command assumes",
    statement="The drive makes another torque of a command than it says: the torque constant is off",
    shows="inertia and every friction torque off by the same factor",
    confused=("inertia", "asymmetry", "torque_saturation"),
    experiment="a known weight or a torque sensor on the shaft",
    terms=terms,
    look=Look("load"),
    far=True,
    one_with=DRIVE_SCALES,
    swift=True,
    scales_torques=True,
    product_with="drive_gain",
    at_level=_at_level,
)
