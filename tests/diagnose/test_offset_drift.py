"""A drift of the constant torque: found where it is, told from a constant one and from friction that drifts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from servod.diagnose.base import document_of
from servod.diagnose.document import diagnosis_document
from servod.diagnose.effects import effect
from servod.diagnose.engine import diagnose
from servod.diagnose.intake import taken_in
from servod.diagnose.predict import Predictor
from servod.diagnose.scene import Scene
from tests.diagnose.axes import believed, record


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


@pytest.mark.parametrize(
    ("name", "hidden"),
    [
        ("torque_offset", {"torque_offset": 0.02}),
        ("thermal", {"thermal": {"dry_per_s": 0.05, "viscous_per_s": 0.05}}),
    ],
)
def test_nothing_else_is_a_drift(name: str, hidden: dict[str, Any]) -> None:
    assert list(findings(**hidden)) == [name]


def test_a_drift_starts_near_its_size() -> None:
    """Least squares on the mismatch gives its rate before any fit, beside a constant offset."""
    model = believed()
    traces, _ = taken_in(record(believed(offset_drift={"per_s": 0.006}, torque_offset=-0.01)), model)
    predictor = Predictor(traces, model)
    straight, ending = effect("offset_drift").terms(Scene(document_of(model), predictor, predictor.mismatch(model)))
    (change,), (changes, time_s) = straight.unknowns, ending.unknowns
    assert change.start == pytest.approx(0.006 * traces[0].duration_s, rel=0.2)
    late = 1.0 - np.exp(-traces[0].duration_s / time_s.start)
    assert changes.start * late == pytest.approx(0.006 * traces[0].duration_s, rel=0.3)
