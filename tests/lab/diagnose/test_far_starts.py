"""What is far from the model is found: a weight of many dry frictions, a resonance anywhere, a spring that stiffens."""

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


def elastic(resonance: float, bend: float = 0.0) -> AxisModel:
    """The believed axis in two halves that swing at this many rad/s, by a spring that stiffens by a share or not."""
    inertia, effort = BELIEVED["inertia"], 0.2
    load = 0.5 * inertia
    stiffness = resonance**2 * 0.25 * inertia
    damping = 0.04 * 2.0 * math.sqrt(stiffness * 0.25 * inertia)
    spring = {"load_inertia": load, "stiffness": stiffness, "damping": damping, "load_viscous": 0.003}
    return believed(joint_elasticity=spring | {"cubic": bend * stiffness**3 / effort**2})


@pytest.mark.parametrize(
    ("multiple", "bend"), [(0.5, 0.0), (1.0, 0.0), (2.0, 0.0), (1.0, 5.0)], ids=["low", "middle", "high", "stiffening"]
)
def test_a_resonance_is_found_wherever_it_is(multiple: float, bend: float) -> None:
    """As a multiple of the observer's bandwidth."""
    rate = Predictor(load_traces(record(believed(), seconds=2.0)[:2], believed())[0], believed()).rate
    selector, base, _ = based(elastic(multiple * rate, bend))
    found = {candidate.effect: candidate.left for candidate in selector.candidates(base)[0]}
    assert min(found, key=lambda name: found[name]) == "joint_elasticity"
    assert found["joint_elasticity"] < 0.05
