"""What a virtual axis conceals: models with and without the effect, and motions that a loop can follow."""

from __future__ import annotations

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.formats.model.axis_model import load_axis_model
from servod.qualify.demo.recovery.walk import CONCEALED, believed_and_true, motions

TABLE1, DEMO = shipped("gains/axes/table1_joint.yaml"), shipped("gains/axes/demo_joint.yaml")


@pytest.mark.parametrize("effect", CONCEALED)
def test_effect_is_in_the_axis_and_not_in_what_is_believed(effect: str) -> None:
    believed, true = believed_and_true(load_axis_model(TABLE1), effect)
    assert believed.model_dump()[effect] in (None, 0.0)
    assert true.model_dump()[effect] not in (None, 0.0)
    assert believed.noise == true.noise
    assert true.model_copy(update={effect: getattr(believed, effect)}) == believed


def test_effect_that_a_plant_has_is_taken_out_of_what_is_believed() -> None:
    plant = load_axis_model(DEMO)
    believed, true = believed_and_true(plant, "asymmetry")
    assert true == plant
    assert believed == plant.model_copy(update={"asymmetry": None})
    with pytest.raises(BadInput, match="--conceal"):
        believed_and_true(plant, "backlash")


def test_motions_begin_and_end_at_rest_within_the_limits() -> None:
    for positions in motions(12.0).values():
        assert len(positions) == 12_000
        assert np.abs(positions[[0, -1]]).max() < 0.02
        assert np.abs(positions).max() < 0.6
        assert np.abs(np.diff(positions)).max() < 2.5e-3
