"""Models that stick and slip along falling friction: what an observer must be to hold them, and how they are fitted.

There the least change of a number lets the model slip elsewhere: its mismatch is rough, and fine differences say
nothing of where it falls.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.predict.predict import Predictor, bandwidth, growth_rate
from servod.lab.diagnose.select.fit import Fitter, Weighing
from servod.lab.diagnose.settings import SETTINGS
from tests.lab.diagnose.axes import BELIEVED, believed, record

Array = NDArray[np.float64]

ROWS = 400


class RoughFitter(Fitter):
    """A straight mismatch in as many directions as there are numbers, and blows in a few rows that come at random.

    They come and go `often` in a radian of each coordinate.
    """

    def __init__(self, hypothesis: Hypothesis, truth: Array, blow: float, often: float = 1e5, rows: int = 20) -> None:
        rng = np.random.default_rng(3)
        self._slopes, self._truth, self._blow = rng.normal(size=(ROWS, len(truth))), truth, blow
        self._often, self._rows = often, rows
        self._phases = rng.uniform(0.0, 6.0, size=(rows, 1))
        super().__init__(Predictor.__new__(Predictor), Weighing(1e-3, np.ones(ROWS)))

    def mismatch(self, hypothesis: Hypothesis, coordinates: Array) -> Array:
        off = self._slopes @ (coordinates - self._truth)
        off[: self._rows] += self._blow * np.sin(self._often * coordinates + self._phases).mean(axis=1)
        return 0.1 * off


@pytest.mark.parametrize(("blow", "rough"), [(0.0, False), (0.3, True)])
def test_a_rough_mismatch_is_fitted_by_wider_differences(blow: float, rough: bool) -> None:
    hypothesis = Hypothesis(document_of(believed()), base_unknowns(believed()))
    truth = hypothesis.start + 0.03
    fitter = RoughFitter(hypothesis, truth, blow)
    begun = fitter.begin(hypothesis)
    assert begun is not None
    fit = fitter.refine(begun, 40)
    assert fit.converged and fit.span == (SETTINGS.fit.wide if rough else 0.0)
    assert np.abs(fit.coordinates - truth).max() < (0.01 if rough else 0.001)


def falling(static_over_coulomb: float) -> AxisModel:
    own = BELIEVED["friction"]
    return AxisModel.model_validate(BELIEVED | {"friction": own | {"static": static_over_coulomb * own["coulomb"]}})


def test_errors_grow_as_fast_as_friction_falls() -> None:
    """Steepest fall of (18), at v_s/sqrt(2): (F_S - F_C)/v_s*sqrt(2/e), less viscous friction, over the inertia."""
    model = falling(3.0)
    law = model.friction
    traces = load_traces(record(model, seconds=2.0)[:1], model)[0]
    steepest = (law.static - law.coulomb) / law.stribeck_velocity * np.sqrt(2.0 / np.e) - law.viscous
    assert steepest > 0.0
    assert growth_rate(model, traces) == pytest.approx(steepest / model.inertia, rel=0.1)
    assert growth_rate(falling(1.0), traces) == 0.0


def test_the_observer_holds_a_model_that_runs_away_where_sampling_and_noise_let_it() -> None:
    model = believed()
    traces = load_traces(record(model, seconds=2.0)[:1], model)[0]

    def rate(growth: float) -> float:
        return bandwidth(model.inertia, model.friction.coulomb, traces, growth)

    over = SETTINGS.observer.over_growth / (2.0 * SETTINGS.observer.poles_damping)
    plain, most = rate(0.0), rate(1e9)
    assert 1.1 * plain < most <= SETTINGS.observer.share_creeping / traces[0].period_s
    between = 0.5 * (plain + most)
    assert rate(between / over) == pytest.approx(between)
    assert rate(0.5 * plain / over) == plain
