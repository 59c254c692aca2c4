"""The mismatch is told as command: no model makes what it leaves out small by being heavy, or weak."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.recordings import Quantity
from tests.lab.diagnose.axes import BELIEVED, believed, record


@cache
def predictor_of(amplitude: float, order: float) -> Predictor:
    """One slow recording of an axis whose motor cogs, which nobody believes."""
    true = believed(cogging={"harmonics": [{"amplitude": amplitude, "periods_per_turn": order}]})
    return Predictor(load_traces(record(true, seconds=2.0)[:1], believed())[0], believed())


def power(predictor: Predictor, model: AxisModel) -> float:
    return float(np.mean(predictor.mismatch(model)[predictor.counts] ** 2))


#: Strong enough that a soft loop gives way to it: twice the mass is then a real rival, eight times is none.
COGGING = st.tuples(st.sampled_from([0.1, 0.3, 0.6]), st.sampled_from([12.0, 25.0]))


@settings(max_examples=8, deadline=None)
@given(COGGING, st.floats(8.0, 50.0))
def test_no_mass_hides_a_torque(hidden: tuple[float, float], factor: float) -> None:
    predictor = predictor_of(*hidden)
    heavy = believed(inertia=factor * BELIEVED["inertia"])
    assert power(predictor, heavy) > power(predictor, believed())


@settings(max_examples=8, deadline=None)
@given(COGGING, st.floats(5.0, 20.0))
def test_no_weaker_drive_hides_a_torque(hidden: tuple[float, float], factor: float) -> None:
    predictor = predictor_of(*hidden)
    most = float(np.max(np.abs(predictor.over("torque"))))
    for weaker in (
        {"torque_gain": {"factor": 1.0 / factor}},
        {"torque_saturation": {"limit": most / factor}},
        {"torque_saturation": {"limit": most / factor, "shape": "tanh"}},
        {"load_dependent_friction": {"per_command": 1.0 - 1.0 / factor}},
    ):
        assert power(predictor, believed(**weaker)) > 0.98 * power(predictor, believed())


@settings(max_examples=8, deadline=None)
@given(st.floats(0.1, 0.8))
def test_no_light_model_hides_the_encoders_noise(factor: float) -> None:
    """An encoder of some hundred steps: its noise is what there is, and a light model shows none of it."""
    made = record(believed(), seconds=2.0)[0]
    coarse = np.round(made.position * 100.0) / 100.0
    noisy = replace(made, columns={**made.columns, Quantity.POSITION: coarse})
    traces, _ = load_traces([noisy], believed())
    predictor = Predictor(traces, believed(), rate=100.0)
    assert power(predictor, believed(inertia=factor * BELIEVED["inertia"])) > 0.9 * power(predictor, believed())
