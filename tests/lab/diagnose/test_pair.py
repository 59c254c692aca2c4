"""Two effects that hide behind one another come in together; where one is enough, or nothing is left, none does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.joint import add_pair
from servod.lab.diagnose.select.selection import Selection
from servod.lab.diagnose.select.selector import Selector
from tests.lab.diagnose.axes import believed, record

#: A weight that holds the command up: what is off by a factor is off all the time.
WEIGHT = {"gravity": {"amplitude": 0.3, "phase": 3.4}}
GAIN = {"torque_gain": {"factor": 1.23}}
RIPPLE = {"torque_ripple": {"harmonics": [{"amplitude": 0.168, "periods_per_turn": 5.0, "phase": 1.16}]}}


def searched(hidden: dict[str, Any]) -> tuple[Selector, Selection, Selection]:
    """The selector of an axis with a weight that hides these, its base, and the base with what comes in as a pair."""
    nominal = believed(**WEIGHT)
    traces, _ = load_traces(record(believed(**WEIGHT, **hidden)), nominal)
    selector = Selector(Predictor(traces, nominal), nominal, 1e12, lambda _line: None)
    base = selector.fit_base()
    candidates, _ = selector.candidates(base.fit)
    return selector, base, add_pair(selector, base, candidates)


def test_a_torque_constant_and_a_ripple_come_in_together() -> None:
    selector, base, found = searched(GAIN | RIPPLE)
    terms = found.fit.hypothesis.terms
    assert {term.effect for term in terms} == {"torque_gain", "torque_ripple"}
    assert selector.error(found.fit.mismatch) < 0.01 * selector.error(base.fit.mismatch)
    assert len(found.merits) == len(found.entries) == 2
    assert all(entry.left < 0.5 for entry in found.entries)
    for term, entry in zip(terms, found.entries, strict=True):
        assert term.effect not in {rival.effect for rival in entry.rivals}


def test_where_nothing_is_left_nothing_comes_in() -> None:
    _, base, found = searched({})
    assert found.fit is base.fit


def test_one_that_is_enough_comes_in_alone_whatever_led_to_it() -> None:
    selector, base, found = searched(RIPPLE)
    assert [term.effect for term in found.fit.hypothesis.terms] == ["torque_ripple"]
    assert selector.error(found.fit.mismatch) < 0.01 * selector.error(base.fit.mismatch)


def test_rate_limits_start_close_to_one_another_up_to_the_steepest_change() -> None:
    """Just above the command's changes one acts nowhere, so that no step from there leads back."""
    traces, _ = load_traces(record(believed()), believed())
    predictor = Predictor(traces, believed())
    scene = SearchContext({}, predictor, predictor.mismatch(believed()))
    terms = [term for term in effect("actuator_lag").terms(scene) if term.form == "rate limit"]
    starts = np.array([term.unknowns[0].start for term in terms])
    assert starts[-1] == pytest.approx(float(np.max(np.abs(np.diff(scene.torque)))) / traces[0].period_s, rel=1e-6)
    assert 1 < len(starts) <= 16
    assert np.all(np.diff(starts) > 0.0)
    assert len(starts) == 16 or np.max(starts[1:] / starts[:-1]) < 1.1 + 1e-9
