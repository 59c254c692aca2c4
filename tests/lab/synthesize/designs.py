"""One synthesized set for Table I's joint, kept in a file for all tests that look at it.

`python -m tests.lab.synthesize.designs` makes the file again, and test_kept_set.py says when that is due.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.synthesize.gain_set import synthesize

MODEL = Path(__file__).resolve().parents[3] / "gains" / "axes" / "table1_joint.yaml"
KEPT = Path(__file__).with_name("table1_set.yaml")


@cache
def table1() -> AxisModel:
    """Table I's joint."""
    return load_axis_model(MODEL)


@cache
def table1_set() -> GainSet:
    """What synthesis makes of it, not yet certified."""
    return load_gains(KEPT)


def made_anew() -> GainSet:
    """The set by synthesis: what the file has to be."""
    found = synthesize(table1(), model_path=MODEL)
    assert isinstance(found, GainSet)
    return found


if __name__ == "__main__":
    KEPT.write_text(made_anew().to_yaml())
