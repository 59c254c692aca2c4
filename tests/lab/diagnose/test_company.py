"""Terms in company: one that was best alone gives way to a better one, and a fit that is not whole gives no name."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.judge.verdict import confidence
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.select.stepwise import add_first, swap_terms
from tests.lab.diagnose.axes import believed, record

#: What a term is said to be worth before anybody has looked.
UNKNOWN = Merit(math.nan, math.nan, math.nan, math.nan)


@pytest.fixture(scope="module")
def selector() -> Selector:
    """The selection on an axis with a weight and friction that differs by direction."""
    hidden = believed(
        gravity={"amplitude": 0.1, "phase": 0.5},
        asymmetry={"positive_dry": 1.15, "negative_dry": 0.85, "positive_viscous": 1.0, "negative_viscous": 1.0},
    )
    predictor = Predictor(load_traces(record(hidden, seconds=2.0), believed())[0], believed())
    return Selector(predictor, believed(), math.inf, lambda _line: None)


def added(selector: Selector, present: Fit, name: str) -> Fit:
    """The fit with the first form of an effect beside what is in."""
    scene = SearchContext(selector.start.document, selector.predictor, present.mismatch)
    hypothesis = present.hypothesis.with_term(effect(name).terms(scene)[0])
    return selector.settle(hypothesis, hypothesis.beside(present.coordinates), present.mismatch)


@pytest.fixture(scope="module")
def mistaken(selector: Selector) -> tuple[Selection, Candidate]:
    """A spring came in where a weight stood as close, and the friction behind it; and that weight."""
    mismatch = selector.predictor.mismatch(believed())
    base = selector.settle(selector.start, None, mismatch)
    weight = Candidate("gravity", added(selector, base, "gravity"), 0.5)
    both = added(selector, added(selector, base, "spring"), "asymmetry")
    entries = (TermEntry(0.5, (weight,)), TermEntry(0.1, ()))
    return Selection(base, both, selector.error(mismatch), 0.0, (UNKNOWN,) * 2, entries, tried=1), weight


def test_what_is_said_of_a_term_that_was_put_in_is_its_own(
    selector: Selector, mistaken: tuple[Selection, Candidate]
) -> None:
    given, _ = mistaken
    selection = swap_terms(selector, given)
    assert [term.effect for term in selection.fit.hypothesis.terms] == ["gravity", "asymmetry"]
    for place, merit in enumerate(selection.merits):
        reduced = selector.settle_without(selection.fit, place)
        assert merit == selector.merit(selection, reduced, selection.fit)
    old = selection.entries[0].rivals[0]
    assert (old.effect, old.term.effect) == ("spring", "spring")
    assert confidence(selection, 0, 1.0) == pytest.approx(0.5)


def bounded(weight: Candidate) -> Candidate:
    """The weight with a range that ends shortly before its best value."""
    sine, cosine = weight.term.unknowns
    most = 0.99 * abs(sine.value(float(weight.own[0])))
    narrow = replace(weight.term, unknowns=(replace(sine, low=-most, high=most), cosine))
    hypothesis = replace(weight.fit.hypothesis, terms=(narrow,))
    at = np.clip(weight.fit.coordinates, *hypothesis.bounds)
    return Candidate("gravity", replace(weight.fit, hypothesis=hypothesis, coordinates=at), weight.left)


def test_a_rival_that_ends_at_the_end_of_a_range_is_not_put_in(
    selector: Selector, mistaken: tuple[Selection, Candidate]
) -> None:
    given, weight = mistaken
    selection = replace(given, entries=(TermEntry(0.5, (bounded(weight),)), given.entries[1]))
    assert swap_terms(selector, selection).fit is given.fit


def test_a_detail_that_ends_at_the_end_of_a_range_does_not_come_in(
    selector: Selector, mistaken: tuple[Selection, Candidate]
) -> None:
    given, weight = mistaken
    for candidate, comes_in in ((bounded(weight), False), (weight, True)):
        bare = replace(given, fit=given.base, merits=(), entries=())
        selection = add_first(selector, bare, [candidate])
        assert selection.terms == len(selection.merits) == len(selection.entries) == int(comes_in)
