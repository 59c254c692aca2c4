"""What is far from the model is found: a weight of many dry frictions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.selector import Selector
from tests.lab.diagnose.axes import BELIEVED, believed, record

FRICTION: dict[str, Any] = BELIEVED["friction"]


def based(true: AxisModel) -> tuple[Selector, Fit, SearchContext]:
    """The fit of the believed model's own parameters to recordings of another."""
    predictor = Predictor(load_traces(record(true, seconds=2.0)[:2], believed())[0], believed())
    selector = Selector(predictor, believed(), math.inf, lambda _line: None)
    base = selector.settle(selector.start, None, predictor.mismatch(believed()))
    return selector, base, SearchContext(selector.start.document, predictor, base.mismatch)


@pytest.mark.parametrize("seed", range(3))
def test_a_weight_of_many_dry_frictions_begins_where_it_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    amplitude, phase = float(rng.uniform(4.0, 10.0)) * FRICTION["coulomb"], float(rng.uniform(-math.pi, math.pi))
    _, _, scene = based(believed(gravity={"amplitude": amplitude, "phase": phase}))
    starts = [[unknown.start for unknown in term.unknowns] for term in effect("gravity").terms(scene)]
    truth = amplitude * np.array([math.cos(phase), math.sin(phase)])
    assert min(float(np.linalg.norm(truth - start)) for start in np.array(starts)) < 0.5 * amplitude
