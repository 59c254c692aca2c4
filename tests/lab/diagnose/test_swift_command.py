"""A command that swings faster than the usual observer shows: the observer follows it, and gaps begin it again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.effects.base import document_of
from servod.lab.diagnose.effects.cogging import whole_orders
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import Predictor, middle_frequency
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.recordings import Quantity
from tests.lab.diagnose.axes import believed, record

#: A bare motor that turns at five radians a second: orders per turn and their torque, N*m.
ORDERS, TURNS = {72: 0.12, 18: 0.04, 12: 0.03}, 5.0

#: The time in which it comes to speed, s: the encoder's step shows there alone.
BEGIN_S = 0.2


def motor() -> AxisModel:
    """What is believed of it: no cogging."""
    friction = {"kind": "coulomb_viscous", "viscous": 0.01, "coulomb": 0.07}
    return AxisModel.model_validate({"inertia": 2.0e-4, "friction": friction})


def turning(seconds: float = 4.0) -> CheckedTrace:
    """A motor under a torque that swings with its cogging, which a stiff loop would make; made without any loop.

    The motion is chosen and the torque is what it needs, so that nothing depends on a loop's tuning.
    """
    made = record(believed(), seconds=seconds)[0]
    t = made.t_s
    begun = np.exp(-t / BEGIN_S)
    position = TURNS * (t - BEGIN_S * (1.0 - begun))
    velocity, acceleration = TURNS * (1.0 - begun), TURNS / BEGIN_S * begun
    cogging = sum(size * np.sin(order * position) for order, size in ORDERS.items())
    torque = 2.0e-4 * acceleration + 0.01 * velocity + 0.07 + cogging
    columns = {**made.columns, Quantity.TORQUE: torque, Quantity.POSITION: np.round(position * 5e4) / 5e4}
    (trace,), refused = load_traces([replace(made, columns=columns)], motor())
    assert refused == []
    return trace


@pytest.fixture(scope="module")
def trace() -> CheckedTrace:
    return turning()


def test_the_observer_follows_a_command_that_swings_with_the_cogging(trace: CheckedTrace) -> None:
    """Order 72 at five radians a second is 360 rad/s: a tenth of the sampling rate would show a thirteenth of it."""
    rate = Predictor([trace], motor()).rate
    asked = middle_frequency(trace.drive)
    assert asked == pytest.approx(72.0 * TURNS, rel=0.02)
    usual = SETTINGS.observer.share_of_sampling / trace.period_s
    assert usual < rate <= SETTINGS.observer.share_creeping / trace.period_s


def test_orders_of_a_motor_with_many_poles_are_seen(trace: CheckedTrace) -> None:
    predictor = Predictor([trace], motor())
    mismatch = predictor.mismatch(motor())
    found = whole_orders(SearchContext(document_of(motor()), predictor, mismatch))
    assert found[0] == 72
    assert set(ORDERS) <= set(found)


def test_a_command_that_does_not_swing_that_fast_leaves_the_observer_as_it_was() -> None:
    traces, refused = load_traces(record(believed(), seconds=3.0), believed())
    assert refused == []
    rate = Predictor(traces, believed()).rate
    assert rate <= SETTINGS.observer.share_of_sampling / traces[0].period_s * (1.0 + 1e-9)
    assert min(middle_frequency(trace.drive) for trace in traces) < rate


def test_the_observer_begins_anew_behind_a_gap_that_hides_the_command(trace: CheckedTrace) -> None:
    """Nine samples are lost, and for as long as the observer remembers them no row counts."""
    drive = trace.drive
    kept = np.ones(len(drive.t_s), dtype=bool)
    kept[2000:2009] = False
    parts = (column[kept] for column in (drive.t_s, drive.torque, drive.position, drive.temperature_c))
    torn = replace(trace, drive=type(drive)(*parts), counts=trace.counts[kept])
    assert 2000 not in torn.starts
    predictor = Predictor([torn], motor())
    assert 2000 in predictor.starts[0]
    settled = int(np.ceil(SETTINGS.observer.settling / predictor.rate / trace.period_s))
    assert not predictor.counts[2000 : 2000 + settled - 1].any()
    assert predictor.counts[2000 + settled + 1]
