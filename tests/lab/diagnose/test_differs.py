"""The sentence of what differs in other recordings, and a drift that another day need not have."""

from __future__ import annotations

import numpy as np
import pytest

from servod.lab.diagnose.document import describe_changes
from servod.lab.diagnose.effects.base import base_unknowns
from servod.lab.diagnose.judge.covariance import inside_region
from servod.lab.diagnose.result import FittedValue
from tests.lab.diagnose.axes import believed


def test_what_differs_is_said_with_its_share() -> None:
    changes = {
        "friction.viscous": FittedValue(210.0, "N·s/m", 205.0, 215.0, 200.0),
        "torque_offset": FittedValue(-0.5, "N", -0.6, -0.4, 0.0),
    }
    said = describe_changes(changes)
    assert "viscous is 210 instead of 200 N·s/m (+5 %)" in said
    assert "torque offset is -0.5 instead of 0 N" in said
    assert describe_changes({}) == ""


@pytest.mark.parametrize("per_s", [0.02, -0.02])
def test_a_drift_of_the_model_may_be_none_in_other_recordings(per_s: float) -> None:
    drift = next(u for u in base_unknowns(believed(offset_drift={"per_s": per_s})) if u.key == "offset_drift.per_s")
    assert (drift.low, drift.high) == (min(per_s, 0.0), max(per_s, 0.0))
    assert drift.value(drift.coordinate(drift.start)) == per_s
    assert all(u.key != "offset_drift.per_s" for u in base_unknowns(believed()))


def test_several_small_changes_together_may_be_told() -> None:
    """Half a standard deviation each: together one in four such by chance, unless they are known to go together."""
    off = np.array([0.5, -0.5])
    assert inside_region(off, np.eye(2))
    assert not inside_region(off, np.array([[1.0, 0.99], [0.99, 1.0]]))
