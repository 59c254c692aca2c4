"""Terms in company: one that was best alone gives way to a better one, and a fit that is not whole gives no name."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servod.lab.diagnose.data.intake import taken_in
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.scene import Scene
from servod.lab.diagnose.judge.verdict import confidence
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.choice import Choice, Entry
from servod.lab.diagnose.select.choose import Chooser
from servod.lab.diagnose.select.detail import swapped, take_first
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit
from tests.lab.diagnose.axes import believed, record

#: What a term is said to be worth before anybody has looked.
UNKNOWN = Merit(math.nan, math.nan, math.nan, math.nan)


@pytest.fixture(scope="module")
def chooser() -> Chooser:
    """The choice on an axis with a weight and friction that differs by direction."""
    hidden = believed(
        gravity={"amplitude": 0.1, "phase": 0.5},
        asymmetry={"positive_dry": 1.15, "negative_dry": 0.85, "positive_viscous": 1.0, "negative_viscous": 1.0},
    )
    predictor = Predictor(taken_in(record(hidden, seconds=2.0), believed())[0], believed())
    return Chooser(predictor, believed(), math.inf, lambda _line: None)


def added(chooser: Chooser, present: Fit, name: str) -> Fit:
    """The fit with the first form of an effect beside what is in."""
    scene = Scene(chooser.start.document, chooser.predictor, present.mismatch)
    hypothesis = present.hypothesis.with_term(effect(name).terms(scene)[0])
    return chooser.settled(hypothesis, hypothesis.beside(present.coordinates), present.mismatch)


@pytest.fixture(scope="module")
def mistaken(chooser: Chooser) -> tuple[Choice, Candidate]:
    """A spring came in where a weight stood as close, and the friction behind it; and that weight."""
    mismatch = chooser.predictor.mismatch(believed())
    base = chooser.settled(chooser.start, None, mismatch)
    chooser.base_error, chooser.floor = chooser.error(mismatch), 0.0
    weight = Candidate("gravity", added(chooser, base, "gravity"), 0.5)
    both = added(chooser, added(chooser, base, "spring"), "asymmetry")
    return Choice(base, both, [UNKNOWN] * 2, [Entry(0.5, [weight]), Entry(0.1, [])], {}, 0.0, 1), weight


def test_what_is_said_of_a_term_that_was_put_in_is_its_own(
    chooser: Chooser, mistaken: tuple[Choice, Candidate]
) -> None:
    given, _ = mistaken
    choice = replace(given, merits=list(given.merits), entries=list(given.entries))
    swapped(chooser, choice)
    assert [term.effect for term in choice.fit.hypothesis.terms] == ["gravity", "asymmetry"]
    for place, merit in enumerate(choice.merits):
        assert merit == chooser.merit(chooser.less(choice.fit, place), choice.fit)
    old = choice.entries[0].rivals[0]
    assert (old.effect, old.term.effect) == ("spring", "spring")
    assert confidence(choice, 0, 1.0) == pytest.approx(0.5)


def bounded(weight: Candidate) -> Candidate:
    """The weight with a range that ends shortly before its best value."""
    sine, cosine = weight.term.unknowns
    most = 0.99 * abs(sine.value(float(weight.own[0])))
    narrow = replace(weight.term, unknowns=(replace(sine, low=-most, high=most), cosine))
    hypothesis = replace(weight.fit.hypothesis, terms=(narrow,))
    at = np.clip(weight.fit.coordinates, *hypothesis.bounds)
    return Candidate("gravity", replace(weight.fit, hypothesis=hypothesis, coordinates=at), weight.left)


def test_a_rival_that_ends_at_the_end_of_a_range_is_not_put_in(
    chooser: Chooser, mistaken: tuple[Choice, Candidate]
) -> None:
    given, weight = mistaken
    entries = [Entry(0.5, [bounded(weight)]), given.entries[1]]
    choice = replace(given, merits=list(given.merits), entries=entries)
    swapped(chooser, choice)
    assert choice.fit is given.fit


def test_a_detail_that_ends_at_the_end_of_a_range_does_not_come_in(
    chooser: Chooser, mistaken: tuple[Choice, Candidate]
) -> None:
    given, weight = mistaken
    for candidate, comes_in in ((bounded(weight), False), (weight, True)):
        choice = replace(given, fit=given.base, merits=[], entries=[])
        assert take_first(chooser, choice, [candidate]) is comes_in
        assert len(choice.fit.hypothesis.terms) == len(choice.merits) == len(choice.entries) == int(comes_in)
