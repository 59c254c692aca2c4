"""What real machines taught: an axis that creeps, cogging of several orders, friction by direction, a drift."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.effects import effect, names, unexcited_effects
from servod.lab.diagnose.effects.base import document_of
from servod.lab.diagnose.effects.cogging import whole_orders
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.selector import Selector
from servod.lab.recordings import load_recording
from tests.conftest import SHARED
from tests.lab.diagnose.axes import believed, record

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"

EMPS = SHARED["recordings/emps"]

ODRIVE = SHARED["recordings/odrive_cogging"]

XL330 = SHARED["recordings/bam_xl330"]


def traces_of(machine: str, path: Path, to_s: float | None = None) -> tuple[list[CheckedTrace], AxisModel]:
    """The traces of one recording of a machine in `examples`, and its model."""
    model = load_axis_model(EXAMPLES / f"{machine}.yaml")
    traces, refused = load_traces([load_recording(path, EXAMPLES / f"{machine}_map.yaml").between(None, to_s)], model)
    assert not refused
    return traces, model


def test_an_axis_in_swift_motion_shows_every_effect() -> None:
    model = believed()
    traces, _ = load_traces(record(model), model)
    assert unexcited_effects(traces, model.inertia) == frozenset()
    assert unexcited_effects(traces, 1e-4 * model.inertia) >= names(lambda what: what.swift)


if ODRIVE.is_dir():

    def test_a_slow_turn_shows_the_orders_of_its_cogging() -> None:
        """Of the five strongest orders in the map of holding currents, at least three."""
        traces, model = traces_of("odrive", ODRIVE / "slow_turn_nocomp_0.csv.gz")
        assert unexcited_effects(traces, model.inertia) == names(lambda what: what.swift or what.directed)
        predictor = Predictor(traces, model)
        orders = whole_orders(SearchContext(document_of(model), predictor, predictor.mismatch(model)))
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


if EMPS.is_dir():

    def test_friction_of_a_ball_screw_differs_by_direction() -> None:
        """One lap of six seconds shows it: viscous friction above all."""
        traces, model = traces_of("emps", EMPS / "DATA_EMPS.mat", to_s=6.24)
        predictor = Predictor(traces, model)
        selector = Selector(predictor, model, math.inf, lambda _line: None)
        base = selector.settle(selector.start, None, predictor.mismatch(model))
        term = effect("asymmetry").terms(SearchContext(document_of(model), predictor, base.mismatch))[0]
        hypothesis = base.hypothesis.with_term(term)
        fit = selector.settle(hypothesis, hypothesis.beside(base.coordinates), base.mismatch)
        assert selector.error(fit.mismatch) < 0.6 * selector.error(base.mismatch)
        asymmetry = fit.model.asymmetry
        assert asymmetry is not None
        assert 1.2 < asymmetry.negative_viscous / asymmetry.positive_viscous < 2.0

    def test_offset_of_a_ball_screw_drifts_by_half_a_newton() -> None:
        """Before any fit, beside whatever else the published model leaves out."""
        traces, model = traces_of("emps", EMPS / "DATA_EMPS.mat")
        predictor = Predictor(traces, model)
        straight = effect("offset_drift").terms(
            SearchContext(document_of(model), predictor, predictor.mismatch(model))
        )[0]
        assert 0.3 < straight.unknowns[0].start < 0.8
