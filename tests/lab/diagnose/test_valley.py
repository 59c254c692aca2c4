"""A fit that lies on the floor of a curved valley goes along it to its bottom, however rough the floor."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from servod.lab.diagnose.effects.hypothesis import Hypothesis, Unknown
from servod.lab.diagnose.select.fit import Fit, Fitter, Weighing, follow

Array = NDArray[np.float64]

#: How much steeper the walls are than the floor, in each of so many rows.
STEEP, ROWS = 20.0, 50


class Valley(Fitter):
    """Rows that say y = x**2 for certain, rows that hardly say x = 1, and a roughness of the first."""

    def __init__(self, rough: float) -> None:
        self.weighing, self.rough = Weighing(1.0, np.ones(2 * ROWS)), rough

    def mismatch(self, _hypothesis: Hypothesis, coordinates: Array) -> Array:
        x, y = coordinates
        wall = STEEP * (y - x * x) + self.rough * np.sin(1e4 * x)
        return np.concatenate([np.full(ROWS, wall), np.full(ROWS, x - 1.0)])


def at_floor(valley: Valley, x: float) -> Fit:
    hypothesis = Hypothesis({}, tuple(Unknown(key, "1", 0.0, -9.0, 9.0, size=1.0) for key in ("x", "y")))
    at = np.array([x, x * x])
    rows = valley.mismatch(hypothesis, at)
    return Fit(hypothesis, at, rows, valley.cost(hypothesis, at, rows), np.zeros((len(rows), 0)), True, span=0.03)


@pytest.mark.parametrize("rough", [0.0, 0.02])
@pytest.mark.parametrize("begun", [0.2, 1.8])
def test_it_goes_to_the_bottom(begun: float, rough: float) -> None:
    valley = Valley(rough)

    def refine(moved: Fit) -> Fit:
        """Down the wall, and nowhere along the floor: as far as a step sees."""
        return at_floor(valley, float(moved.coordinates[0]))

    ended = follow(valley, refine, at_floor(valley, begun))
    assert ended.coordinates[0] == pytest.approx(1.0, abs=0.15)
    assert ended.cost < 0.05 * at_floor(valley, begun).cost


def test_at_the_bottom_it_stays() -> None:
    valley = Valley(0.0)
    bottom = at_floor(valley, 1.0)
    assert follow(valley, lambda moved: moved, bottom) is bottom
