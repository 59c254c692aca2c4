"""The mismatch of the true model is noise, and that of a wrong one is the torque that it lacks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servod.common.shipped import shipped
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.formats.model.effects import Gravity
from servod.kernels.laws import LAWS
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.selection import Selection
from servod.lab.diagnose.select.selector import Selector
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.tracking.metrics import paper_rows
from tests.lab.diagnose.axes import GAINS, believed, record, recording

#: A weight that pulls nearly the same way wherever the joint stands.
GRAVITY = Gravity(amplitude=0.02, phase=1.5)

HIDDEN: list[dict[str, Any]] = [
    {},
    {"asymmetry": {"positive_dry": 1.2, "negative_dry": 0.9}},
    {"spring": {"stiffness": 0.3, "rest": 0.1}},
    {"cogging": {"harmonics": [{"amplitude": 0.03, "periods_per_turn": 12.0, "phase": 0.4}]}},
    {"joint_elasticity": {"load_inertia": 0.012, "stiffness": 90.0, "damping": 0.05, "load_viscous": 0.004}},
    {"delay": {"additional_s": 0.0063}},
    {"actuator_lag": {"time_constant_s": 0.006}},
    {"position_dependent_inertia": {"harmonics": [{"amplitude": 0.2, "periods_per_turn": 1.0}]}},
    {"encoder_eccentricity": {"harmonics": [{"amplitude": 0.004, "periods_per_turn": 2.0}]}},
    {"viscous_nonlinear": {"quadratic": 0.01}, "torque_gain": {"factor": 1.2}},
]


@pytest.mark.parametrize("hidden", HIDDEN, ids=lambda h: "+".join(h) or "nothing")
def test_true_model_leaves_noise(hidden: dict[str, Any]) -> None:
    true = believed(**hidden)
    traces, refused = load_traces(record(true), believed())
    assert refused == []
    predictor = Predictor(traces, believed())
    left = rms(predictor, true)
    assert left < 0.015
    if hidden:
        assert rms(predictor, believed()) > 5.0 * left


def test_the_joint_starts_where_it_is_and_not_where_a_wave_of_the_encoder_shows_it() -> None:
    """The correction of 7 mrad would drag the bristle along, and a joint that stands still would lack its torque."""
    wave = {"amplitude": 0.0075, "periods_per_turn": 2.0, "phase": 1.2}
    true, reference = believed(encoder_eccentricity={"harmonics": [wave]}), np.zeros((2000, 3))
    reference[:, 0] = 0.0075 * np.sin(1.2) + 0.3 * np.clip(np.arange(2000) * 1e-3 - 0.5, 0.0, None) ** 2
    run = simulate_closed_loop(true, LAWS["pd"], GAINS, reference, LoopSettings(counts_per_turn=2.0**20))
    traces, _ = load_traces([recording(run.t_s, run.torque_nm, run.encoder_rad)], believed())
    predictor = Predictor(traces, believed())
    assert rms(predictor, true) < 0.01


def rms(predictor: Predictor, model: AxisModel) -> float:
    return float(np.sqrt(np.mean(predictor.mismatch(model)[predictor.counts] ** 2))) / predictor.dry


def test_mismatch_is_the_missing_torque() -> None:
    true = believed(spring={"stiffness": 0.2, "rest": 0.0})
    traces, _ = load_traces(record(true)[:1], believed())
    predictor = Predictor(traces, believed())
    mismatch = predictor.mismatch(believed())
    late = traces[0].drive.position - 1.6 / predictor.rate * traces[0].velocity
    fast = predictor.counts & (np.abs(traces[0].velocity) > 0.5)
    assert np.polyfit(late[fast], mismatch[fast], 1)[0] == pytest.approx(-0.2, rel=0.05)


def test_rows_after_a_gap_begin_anew() -> None:
    made = record(believed())[0]
    keep = (made.t_s < 2.0) | (made.t_s > 2.6)
    columns = {quantity: values[keep] for quantity, values in made.columns.items()}
    cut = type(made)(made.path, made.axis, columns, made.measured[keep], ())
    traces, _ = load_traces([cut], believed())
    predictor = Predictor(traces, believed())
    assert len(traces[0].starts) == 2
    assert rms(predictor, believed()) < 0.015


def test_a_model_never_sticks_where_the_joint_slides_slowly() -> None:
    """Within the Stribeck curve of a stiff bristle an observer could hold a sticking model along for good."""
    true = load_axis_model(shipped("gains/axes/table1_joint.yaml")).model_copy(update={"gravity": GRAVITY})
    settings = LoopSettings(counts_per_turn=2.0**20)
    run = simulate_closed_loop(true, LAWS["pd"], (30.0, 0.3, 0.0), paper_rows(1e-3, 14.0), settings)
    believed_without = true.model_copy(update={"gravity": None})
    traces, refused = load_traces([recording(run.t_s, run.torque_nm, run.encoder_rad)], believed_without)
    assert refused == []
    predictor = Predictor(traces, believed_without)
    assert rms(predictor, true) < 0.03
    seen = predictor.mismatch(believed_without)[predictor.counts]
    assert np.median(seen) == pytest.approx(-GRAVITY.amplitude, rel=0.1)


def test_own_torque_is_what_the_term_stands_for() -> None:
    """Friction of 6 % of the command beside parameters that have not moved."""
    model = believed()
    selector = Selector(Predictor(load_traces(record(model, seconds=3.0), model)[0], model), model, 1e9, print)
    term = effect("load_dependent_friction").terms(
        SearchContext(selector.start.document, selector.predictor, np.zeros(0))
    )[0]
    mismatch = selector.predictor.mismatch(model)
    base = selector.fitter(mismatch).begin(selector.start)
    hypothesis = selector.start.with_term(term)
    beside = selector.fitter(mismatch).begin(hypothesis, np.append(selector.start.start, 0.6))
    assert base is not None and beside is not None
    selection = Selection(base, base, selector.error(base.mismatch), 0.0)
    merit = selector.merit(selection, base, beside)
    assert merit.own == pytest.approx(merit.torque)
    assert merit.own > 0.06
