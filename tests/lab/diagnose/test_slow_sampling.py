"""Recordings at a hundred rows a second: friction is still seen, and most of a short run counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.predict.predict import Predictor, bandwidth
from servod.lab.recordings import Quantity
from tests.lab.diagnose.axes import BELIEVED, believed, record


def every_tenth() -> CheckedTrace:
    """A run of six seconds of which every tenth row is left; its command is the mean over the rows between."""
    made = record(believed(), seconds=6.0)[0]
    count = len(made.t_s) // 10
    columns = {quantity: values[: 10 * count : 10] for quantity, values in made.columns.items()}
    means = made.torque[: 10 * count].reshape(count, 10).mean(axis=1)
    slow = replace(made, columns={**columns, Quantity.TORQUE: means})
    slow = replace(slow, measured=made.measured[: 10 * count : 10])
    (trace,), refused = load_traces([slow], believed())
    assert refused == []
    return trace


@pytest.fixture(scope="module")
def trace() -> CheckedTrace:
    return every_tenth()


def test_most_of_a_short_run_counts(trace: CheckedTrace) -> None:
    predictor = Predictor([trace], believed())
    assert float(np.mean(predictor.counts)) > 0.85


@settings(max_examples=20, deadline=None)
@given(st.floats(0.3, 3.0), st.floats(0.3, 3.0))
def test_the_observer_reaches_a_third_of_the_sampling_rate(trace: CheckedTrace, heavy: float, dry: float) -> None:
    """Whatever the axis, as far as the encoder allows."""
    inertia, friction = heavy * BELIEVED["inertia"], dry * BELIEVED["friction"]["coulomb"]
    rate = bandwidth(inertia, friction, [trace])
    assert rate * trace.period_s == pytest.approx(0.33, abs=0.02)
