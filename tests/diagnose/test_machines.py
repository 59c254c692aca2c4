"""What real machines taught: an axis that creeps, cogging of several orders; on the recordings where they are there."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servod.axis_model import AxisModel, load_axis_model
from servod.diagnose.base import document_of
from servod.diagnose.effects.cogging import whole_orders
from servod.diagnose.excited import DIRECTED, SWIFT, unseen
from servod.diagnose.intake import taken_in
from servod.diagnose.predict import Predictor
from servod.diagnose.scene import Scene
from servod.diagnose.trace import Trace
from servod.recordings import load_recording
from tests.conftest import SHARED
from tests.diagnose.axes import believed, record

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

ODRIVE = SHARED["recordings/odrive_cogging"]

XL330 = SHARED["recordings/bam_xl330"]


def traces_of(machine: str, path: Path) -> tuple[list[Trace], AxisModel]:
    """The traces of one recording of a machine in `examples`, and its model."""
    model = load_axis_model(EXAMPLES / f"{machine}.yaml")
    traces, refused = taken_in([load_recording(path, EXAMPLES / f"{machine}_map.yaml")], model)
    assert not refused
    return traces, model


def test_an_axis_in_swift_motion_shows_every_effect() -> None:
    model = believed()
    traces, _ = taken_in(record(model), model)
    assert unseen(traces, model.inertia) == frozenset()
    assert unseen(traces, 1e-4 * model.inertia) >= SWIFT


if ODRIVE.is_dir():

    def test_a_slow_turn_shows_the_orders_of_its_cogging() -> None:
        """Of the five strongest orders in the map of holding currents, at least three."""
        traces, model = traces_of("odrive", ODRIVE / "slow_turn_nocomp_0.csv.gz")
        assert unseen(traces, model.inertia) == SWIFT | DIRECTED
        predictor = Predictor(traces, model)
        orders = whole_orders(Scene(document_of(model), predictor, predictor.mismatch(model)))
        held = np.loadtxt(ODRIVE / "static_hold_map.csv.gz", delimiter=",", skiprows=1)[:, 1]
        strongest = np.argsort(-np.abs(np.fft.rfft(held - held.mean())))[:5]
        assert len({*strongest.tolist()} & set(orders)) >= 3


if XL330.is_dir():

    def test_the_weight_of_a_pendulum_takes_most_of_its_mismatch() -> None:
        traces, model = traces_of("xl330", XL330 / "sin_time_square_kp100.csv.gz")
        predictor = Predictor(traces, model)
        pendulum = AxisModel.model_validate({**document_of(model), "gravity": {"amplitude": 0.48}})
        before, after = (float(np.var(predictor.mismatch(m)[predictor.counts])) for m in (model, pendulum))
        assert after < 0.2 * before
