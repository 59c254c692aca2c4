"""A drift of the constant torque: found where it is, told from a constant one and from friction that drifts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.document import diagnosis_document
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.base import document_of
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.engine import diagnose
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.selection import Selection
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.select.stepwise import add_drift
from servod.lab.diagnose.settings import SETTINGS
from tests.lab.diagnose.axes import believed, record


def findings(**hidden: Any) -> dict[str, Any]:
    """Findings of a diagnosis by their effect."""
    document = diagnosis_document(diagnose(believed(), record(believed(**hidden))))
    return {finding["effect"]: finding for finding in document["findings"]}


def test_a_drift_is_named() -> None:
    found = findings(offset_drift={"per_s": 0.006})
    assert list(found) == ["offset_drift"]
    values = {name: value["value"] for name, value in found["offset_drift"]["parameters"].items()}
    lasts = values.get("time_s", 1e6)
    assert values["per_s"] * lasts * (1.0 - math.exp(-5.0 / lasts)) == pytest.approx(0.03, rel=0.05)


def test_friction_that_drifts_is_none() -> None:
    assert list(findings(thermal={"dry_per_s": 0.05, "viscous_per_s": 0.05})) == ["thermal"]


def test_a_drift_starts_near_its_size() -> None:
    """Least squares on the mismatch gives its rate before any fit, beside a constant offset."""
    model = believed()
    traces, _ = load_traces(record(believed(offset_drift={"per_s": 0.006}, torque_offset=-0.01)), model)
    predictor = Predictor(traces, model)
    straight, ending = effect("offset_drift").terms(
        SearchContext(document_of(model), predictor, predictor.mismatch(model))
    )
    (change,), (changes, time_s) = straight.unknowns, ending.unknowns
    assert change.start == pytest.approx(0.006 * traces[0].duration_s, rel=0.2)
    late = 1.0 - np.exp(-traces[0].duration_s / time_s.start)
    assert changes.start * late == pytest.approx(0.006 * traces[0].duration_s, rel=0.3)


@pytest.mark.parametrize(
    ("hidden", "terms"), [({"offset_drift": {"per_s": 0.0006}}, ["offset_drift"]), ({"torque_offset": 0.002}, [])]
)
def test_a_small_drift_is_found_over_seconds(hidden: dict[str, Any], terms: list[str]) -> None:
    """2.5 % of dry friction over the recording: under what any row shows of an effect worth naming."""
    model = believed()
    traces, _ = load_traces(record(believed(**hidden)), model)
    predictor = Predictor(traces, model)
    selector = Selector(predictor, model, math.inf, lambda _line: None)
    base = selector.settle(selector.start, None, predictor.mismatch(model))
    selection = add_drift(selector, Selection(base, base, 0.0, 0.0))
    assert [term.effect for term in selection.fit.hypothesis.terms] == terms
    if terms:
        assert selection.fit.values[-1] / traces[0].duration_s == pytest.approx(0.0006, rel=0.15)
        assert selection.merits[0].torque < SETTINGS.group.least_torque
