"""What deserves a name: torque where it acts, levels below which every axis has some, and how much is explained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.disturbance import SHORTEST_S, windows
from servod.lab.diagnose.effects.disturbance import terms as windows_of
from servod.lab.diagnose.effects.effect import sine_term
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.effects.search_context import Peak, SearchContext
from servod.lab.diagnose.judge.verdict import Shares, alternatives, verdict
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import DiagnosisVerdict
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.levels import at_end_of_range, named_terms
from servod.lab.diagnose.select.merit import Merit, acting_torque, worth_naming
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.settings import SETTINGS
from tests.lab.diagnose.axes import believed, record


@pytest.fixture(scope="module")
def scene() -> SearchContext:
    """An axis with nothing left but a push in the last tenth of a second of its last recording."""
    model = believed()
    predictor = Predictor(load_traces(record(model, seconds=3.0), model)[0], model)
    mismatch = np.zeros(len(predictor.counts))
    mismatch[-100:] = 0.05
    return SearchContext(document_of(model), predictor, mismatch)


def with_ripple(scene: SearchContext, amplitude: float) -> Fit:
    term = sine_term("torque_ripple", scene, Peak(5.0, amplitude, 0.0, 0.0), 0.1, "1", most=0.45)
    hypothesis = Hypothesis(scene.document, base_unknowns(believed()), (term,))
    return Fit(hypothesis, hypothesis.start, scene.mismatch, 0.0, np.zeros((0, 0)), True)


def test_torque_is_judged_where_it_acts() -> None:
    t = np.linspace(0.0, 50.0, 20_001)
    assert acting_torque(0.01 * np.abs(np.sin(t))) < SETTINGS.worth.least_torque
    blows = np.where(t % 5.0 < 0.04, 0.03, 0.0)
    assert np.quantile(blows, 0.98) == 0.0
    assert acting_torque(blows) == pytest.approx(0.03)
    assert acting_torque(np.zeros(3)) == 0.0


def test_ripple_that_every_motor_has_is_no_finding(scene: SearchContext) -> None:
    assert named_terms(with_ripple(scene, 0.01), scene.document) == ()
    assert named_terms(with_ripple(scene, 0.04), scene.document) == (0,)


def test_a_push_lies_within_its_recording(scene: SearchContext) -> None:
    """One that begins shortly before the end could be any blow, and nobody has seen how long it lasts."""
    last = scene.predictor.traces[-1].drive.t_s[-1] - scene.predictor.traces[-1].shift_s
    for term in windows_of(scene):
        start, length, _ = term.unknowns
        assert start.low <= start.start <= start.high <= last - SHORTEST_S + 1e-9
        assert length.low == SHORTEST_S


@pytest.mark.parametrize(
    ("removed", "left", "answer"),
    [
        (0.83, 0.04, DiagnosisVerdict.UNEXPLAINED),
        (0.88, 0.04, DiagnosisVerdict.MISSING_PHYSICS),
        (0.91, 0.15, DiagnosisVerdict.UNEXPLAINED),
        (0.94, 0.15, DiagnosisVerdict.MISSING_PHYSICS),
        (0.60, 0.01, DiagnosisVerdict.MISSING_PHYSICS),
        (0.14, 0.01, DiagnosisVerdict.UNEXPLAINED),
        (0.16, 0.01, DiagnosisVerdict.MISSING_PHYSICS),
    ],
)
def test_names_must_explain_most_of_what_is_left(removed: float, left: float, answer: DiagnosisVerdict) -> None:
    """Names that leave a sixth of the explainable error are somebody else's, unless what they leave is next to none.

    `left` is a share of dry friction.
    """
    after = float(np.sqrt(1.0 - removed))
    assert verdict((0,), Shares(1.0, after, 0.0, removed), dry=after / left) is answer


def test_a_number_at_an_end_of_its_range_is_somebody_elses(scene: SearchContext) -> None:
    """Twenty times the mass; but no stiffness at all is just no spring."""
    mass = Hypothesis(scene.document, base_unknowns(believed()), tuple(effect("inertia").terms(scene)))
    spring = Hypothesis(scene.document, base_unknowns(believed()), (effect("spring").terms(scene)[0],))
    for hypothesis, at, answer in ((mass, 20.0, True), (mass, 2.0, False), (spring, 0.0, False)):
        place = 0 if hypothesis is mass else len(hypothesis.base)
        unknown = hypothesis.unknowns[place]
        coordinates = hypothesis.start.copy()
        coordinates[place] = unknown.coordinate(at * 0.02 if hypothesis is mass else at)
        assert at_end_of_range(Fit(hypothesis, coordinates, scene.mismatch, 0.0, np.zeros((0, 0)), True)) is answer


def test_a_bristle_may_have_no_damping_and_must_have_a_stiffness(scene: SearchContext) -> None:
    """Whether the model has it already or not."""
    friction = {"kind": "coulomb_viscous", "coulomb": 0.12, "viscous": 0.02}
    plain = replace(scene, document=document_of(believed(friction=friction)))
    term = effect("presliding").terms(plain)[0]
    hypothesis = Hypothesis(plain.document, base_unknowns(believed(friction=friction)), (term,))
    for place, answer in ((0, True), (1, False)):
        coordinates = hypothesis.start.copy()
        coordinates[hypothesis.share(0).start + place] = term.unknowns[place].coordinate(term.unknowns[place].low)
        assert at_end_of_range(Fit(hypothesis, coordinates, scene.mismatch, 0.0, np.zeros((0, 0)), True)) is answer


def test_a_window_is_found_where_it_begins_and_ends() -> None:
    """Of any length, and a second one beside it, within a twentieth of a second."""
    left = 0.01 * np.random.default_rng(1).normal(size=16_001)
    left[4692:5951] += 0.3
    left[9000:9400] -= 0.2
    (_, first, last), (_, begun, ended) = windows(left, 1e-3)
    assert [first, last, begun, ended] == pytest.approx([4692, 5951, 9000, 9400], abs=50)
    assert windows(left[:100], 1e-3) == []


def test_a_drive_that_is_late_has_one_name(scene: SearchContext) -> None:
    """A lag of second order is a delay and a lag to a model of first order: the longer names both."""
    terms = (effect("delay").terms(scene)[0], effect("actuator_lag").terms(scene)[0])
    hypothesis = Hypothesis(scene.document, base_unknowns(believed()), terms)
    coordinates = hypothesis.start.copy()
    for late, lag, places in ((0.002, 0.003, (1,)), (0.006, 0.001, (0,))):
        for place, value in ((0, late), (1, lag)):
            coordinates[hypothesis.share(place)] = terms[place].unknowns[0].coordinate(value)
        fit = Fit(hypothesis, coordinates, scene.mismatch, 0.0, np.zeros((0, 0)), True)
        selection = Selection(fit, fit, 0.0, 0.0, (), (TermEntry(0.1, ()), TermEntry(0.1, ())))
        assert named_terms(fit, scene.document) == places
        assert alternatives(selection, places[0]) == [terms[1 - places[0]].effect]


@pytest.mark.parametrize(
    ("share", "of_left", "torque", "answer"),
    [(0.08, 0.2, 0.05, False), (0.08, 0.3, 0.05, True), (0.9, 0.2, 0.05, True), (0.9, 0.9, 0.012, False)],
)
def test_a_name_takes_a_good_part_of_what_is_left(share: float, of_left: float, torque: float, answer: bool) -> None:
    assert worth_naming(Merit(share, of_left, torque, 1e4), level=False) is answer
