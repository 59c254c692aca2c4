"""Which form of an effect is found, and how far a fit is carried before it is told."""

from __future__ import annotations

import math
from time import monotonic
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws import LAWS
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.document import diagnosis_document
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.engine import diagnose
from servod.lab.diagnose.predict.predict import Predictor, fine_step_s
from servod.lab.diagnose.select import stepwise
from servod.lab.diagnose.select.forms import better_forms
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.recordings import Recording
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from tests.lab.diagnose.axes import BELIEVED, GAINS, believed, record, recording, references, rows
from tests.lab.diagnose.test_rough import ROWS, RoughFitter

Array = NDArray[np.float64]


def selector_of(made: list[Recording], model: AxisModel) -> Selector:
    traces, _ = load_traces(made, model)
    return Selector(Predictor(traces, model), model, monotonic() + 600.0, lambda _line: None)


def test_a_spring_is_straight_where_it_is_fitted_as_one_that_stiffens() -> None:
    selector = selector_of(record(believed(spring={"stiffness": 0.1, "rest": 0.1}), seconds=3.0), believed())
    selection = selector.fit_base()
    scene = SearchContext(selector.start.document, selector.predictor, selection.fit.mismatch)
    stiffening = next(term for term in effect("spring").terms(scene) if term.form == "stiffening")
    hypothesis = selection.fit.hypothesis.with_term(stiffening)
    fit = selector.settle(hypothesis, hypothesis.beside(selection.fit.coordinates), selection.fit.mismatch)
    merit = selector.merit(selection, selection.fit, fit)
    found = better_forms(selector, selection.with_term(fit, merit, TermEntry(0.1, ())))
    assert [term.form for term in found.fit.hypothesis.terms] == ["straight"]
    assert found.fit.model.spring is not None
    assert found.fit.model.spring.stiffness == pytest.approx(0.1, rel=0.02)


class RoughSelector(Selector):
    """A selector of one rough mismatch, whatever the recordings."""

    def __init__(self, rough: RoughFitter) -> None:
        self._rough, self.deadline = rough, math.inf

    def fitter(self, _mismatch: Array) -> RoughFitter:
        return self._rough


def test_what_is_told_is_fitted_further_than_fine_differences_lead() -> None:
    hypothesis = Hypothesis(document_of(believed()), base_unknowns(believed()))
    truth = hypothesis.start + 0.05
    selector = RoughSelector(RoughFitter(hypothesis, truth, 3.0, 100.0, ROWS))
    settled = selector.settle(hypothesis, None, np.zeros(ROWS))
    assert selector.polished(settled).cost < 0.7 * settled.cost


def test_a_stiff_bristle_is_simulated_in_steps_that_it_asks_for() -> None:
    """In steps of a sample it is another bristle, and a softer one would make less of a mismatch than its own."""
    own = BELIEVED["friction"] | {"sigma0": 2e4, "sigma1": 5.0}
    model = believed(inertia=0.004, friction=own)
    traces, _ = load_traces(record(model, seconds=2.0, noise=1e-5), model)

    def mismatch(step_s: float) -> Array:
        return Predictor(traces, model, None, step_s).mismatch(model)

    finest = mismatch(5e-5)
    fine, coarse = (
        float(np.sqrt(np.mean((mismatch(step_s) - finest) ** 2)))
        for step_s in (fine_step_s(model), SETTINGS.observer.longest_step_s)
    )
    assert fine < 0.4 * coarse
    assert fine_step_s(believed(inertia=20.0)) == SETTINGS.observer.longest_step_s


def told(made: list[Recording], model: AxisModel | None = None) -> dict[str, Any]:
    return diagnosis_document(diagnose(model or believed(), made))


def findings(made: list[Recording]) -> dict[str, Any]:
    return {finding["effect"]: finding for finding in told(made)["findings"]}


def swung(model: AxisModel, seconds: float = 5.0) -> list[Recording]:
    """Recordings of an axis that travels more than half a turn."""
    made = []
    for index, reference in enumerate(references(seconds)):
        run = simulate_closed_loop(
            model, LAWS["pd"], GAINS, rows(4.0 * reference[:, 0]), LoopSettings(counts_per_turn=2.0**20)
        )
        made.append(recording(run.t_s, run.torque_nm, run.encoder_rad, f"run{index}.csv"))
    return made


def test_a_weight_on_a_linkage_is_no_cogging() -> None:
    """It pulls with a second wave in a turn, which two sines of cogging have as well."""
    second = {"amplitude": 0.02, "periods_per_turn": 2.0, "phase": 0.4}
    found = findings(swung(believed(gravity={"amplitude": 0.15, "phase": 0.7}, cogging={"harmonics": [second]})))
    assert list(found) == ["gravity"]
    values = {name: value["value"] for name, value in found["gravity"]["parameters"].items()}
    assert values["amplitude"] == pytest.approx(0.15, rel=0.02)
    assert values["amplitude_2"] == pytest.approx(0.02, rel=0.1)


def test_two_waves_in_a_turn_without_a_weight_are_cogging() -> None:
    wave = {"amplitude": 0.1, "periods_per_turn": 2.0, "phase": 0.6}
    found = findings(swung(believed(cogging={"harmonics": [wave]}), 4.0))
    assert list(found) == ["cogging"]
    assert found["cogging"]["parameters"]["amplitude"]["value"] == pytest.approx(0.1, rel=0.02)


def test_one_wave_in_a_turn_is_never_cogging() -> None:
    """Its order is searched from peaks beside once in a turn, and would be pulled there."""
    selector = selector_of(swung(believed(gravity={"amplitude": 0.9, "phase": -1.2}), 3.0), believed())
    left = selector.predictor.mismatch(believed())
    for term in effect("cogging").terms(SearchContext(selector.start.document, selector.predictor, left)):
        orders = [unknown for unknown in term.unknowns if unknown.key == "n"]
        assert all(not order.low < 1.0 < order.high for order in orders)


def test_friction_that_drifts_until_it_has_arrived_is_told_with_its_time() -> None:
    found = findings(record(believed(thermal={"dry_per_s": -0.1, "viscous_per_s": -0.05, "drift_time_s": 4.0}), 8.0))
    assert list(found) == ["thermal"]
    values = {name: value["value"] for name, value in found["thermal"]["parameters"].items()}
    assert values["dry_per_s"] == pytest.approx(-0.1, rel=0.05)
    assert values["drift_time_s"] == pytest.approx(4.0, rel=0.1)


def test_a_spring_far_above_the_observers_bandwidth_is_found() -> None:
    """A load of 40 % of the motor's inertia at 100 Hz, pushed by blows that hold that frequency."""
    load, motor, rate = 0.02 * 0.4 / 1.4, 0.02 / 1.4, 2.0 * np.pi * 100.0
    reduced = load * motor / (load + motor)
    model = believed(
        joint_elasticity={"load_inertia": load, "stiffness": reduced * rate**2, "damping": 0.05 * reduced * rate}
    )
    made, rng = [], np.random.default_rng(4)
    for index, reference in enumerate(references(5.0)):
        blows = 0.3 * np.repeat(rng.choice([-1.0, 1.0], len(reference) // 5 + 1), 5)[: len(reference)]
        kicked = reference + np.outer(blows / GAINS[1], [0.0, 1.0, 0.0])
        run = simulate_closed_loop(model, LAWS["pd"], GAINS, kicked, LoopSettings(counts_per_turn=2.0**20))
        made.append(recording(run.t_s, run.torque_nm, run.encoder_rad, f"run{index}.csv"))
    found = findings(made)
    assert list(found) == ["joint_elasticity"]
    assert found["joint_elasticity"]["parameters"]["load_inertia"]["value"] == pytest.approx(load, rel=0.1)


@pytest.mark.parametrize("behind", [0.0, 0.5])
def test_a_spring_is_found_wherever_viscous_friction_acts(behind: float) -> None:
    """None of it on the load or half: what is assumed of it went into damping, delay and a spring that stiffens."""
    spring = {"load_inertia": 0.01, "stiffness": 180.0, "damping": 0.06}
    friction = BELIEVED["friction"] | {"viscous": 0.1}
    model = believed(friction=friction, joint_elasticity=spring | {"load_viscous": 0.1 * behind})
    document = told(record(model, seconds=5.0), believed(friction=friction))
    assert [(finding["effect"], finding["form"]) for finding in document["findings"]] == [
        ("joint_elasticity", ["two masses"])
    ]
    for name, true in spring.items():
        low, high = document["findings"][0]["parameters"][name]["interval"]
        assert low <= true <= high
    assert document["recalibrated"] == {}


@pytest.mark.parametrize("delay_s", [0.003, 0.0047])
def test_a_dead_time_is_told_with_its_whole_length(delay_s: float) -> None:
    """At its level, which an estimate may fall short of, and beyond it."""
    found = findings(record(believed(delay_s=delay_s), seconds=5.0))
    assert list(found) == ["delay"]
    low, high = found["delay"]["parameters"]["additional_s"]["interval"]
    assert low <= delay_s - 0.001 <= high
    assert high - low < 2e-4


def standing(*names: str) -> Selection:
    """As much of a selection as the search asks for its terms."""
    terms = [SimpleNamespace(effect=name, form="") for name in names]
    return cast(
        Selection, SimpleNamespace(terms=len(names), fit=SimpleNamespace(hypothesis=SimpleNamespace(terms=terms)))
    )


def test_a_search_ends_where_two_terms_drive_each_other_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A servo's delay and its lag came and went until time ended the search, and its answer with it."""
    turns = []

    def add_the_other(_selector: Selector, selection: Selection) -> Selection:
        names = [term.effect for term in selection.fit.hypothesis.terms]
        turns.append(names)
        return standing(*names, "delay" if names[-1] == "actuator_lag" else "actuator_lag")

    def drop_the_older(_selector: Selector, selection: Selection) -> Selection:
        first, *_, last = selection.fit.hypothesis.terms
        return standing(first.effect, last.effect)

    monkeypatch.setattr(stepwise, "_add_best", add_the_other)
    monkeypatch.setattr(stepwise, "backward_elimination", drop_the_older)
    selector = cast(Selector, SimpleNamespace(nothing_left=lambda _selection: False, deadline=monotonic() + 60.0))
    found = stepwise.forward_selection(selector, standing("spring"))
    assert turns == [["spring"], ["spring", "actuator_lag"], ["spring", "delay"]]
    assert [term.effect for term in found.fit.hypothesis.terms] == ["spring", "actuator_lag"]


def test_a_push_in_one_recording_is_told_of_it_alone() -> None:
    made = record(believed(), seconds=12.0)
    reference, push = references(12.0)[2], np.zeros(12_000)
    push[2_300:4_900] = -0.05
    noise = 0.001 * np.random.default_rng(9).normal(size=len(reference))
    run = simulate_closed_loop(
        believed(), LAWS["pd"], GAINS, reference, LoopSettings(counts_per_turn=2.0**20),
        external_nm=noise + push[: len(reference)],
    )  # fmt: skip
    made[2] = recording(run.t_s, run.torque_nm, run.encoder_rad, "run2.csv")
    found = findings(made)
    assert list(found) == ["disturbance"]
    assert found["disturbance"]["form"] == ["in one recording"]
    assert abs(found["disturbance"]["parameters"]["torque"]["value"]) == pytest.approx(0.05, rel=0.05)
