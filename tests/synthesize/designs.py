"""One synthesized set for Table I's joint, made once for all tests that look at it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from servod.axis_model import AxisModel, load_axis_model
from servod.gains import GainSet
from servod.synthesize.gain_set import synthesize

MODEL = Path(__file__).resolve().parents[2] / "gains" / "axes" / "table1_joint.yaml"


@cache
def table1() -> AxisModel:
    """Table I's joint."""
    return load_axis_model(MODEL)


@cache
def table1_set() -> GainSet:
    """What synthesis makes of it, not yet certified."""
    found = synthesize(table1(), model_path=MODEL)
    assert isinstance(found, GainSet)
    return found
