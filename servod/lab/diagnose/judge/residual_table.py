"""What fits no known physics: kept as a table over the coordinate where it lives, without a name.

Stands behind the selection: the table becomes `residual` in the axis model file.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import ResidualTable
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


def residual_table(predictor: Predictor, mismatch: Array) -> ResidualTable | None:
    """The table that predicts most of the mismatch of unseen stretches; None where none predicts enough."""
    late = 2.0 * SETTINGS.observer.poles_damping / predictor.rate
    velocity = predictor.over("velocity")
    places = {
        "position": predictor.over("position") - late * velocity,
        "velocity": velocity - late * predictor.over("acceleration"),
    }
    found = [_table(name, values, predictor, mismatch) for name, values in places.items()]
    best = max(found, key=lambda table: table.share)
    return best if best.share >= SETTINGS.maps.table_least_share else None


def _table(name: str, values: Array, predictor: Predictor, mismatch: Array) -> ResidualTable:
    """Least squares of a piecewise linear function, and its share on every second stretch from the others."""
    rows = np.flatnonzero(predictor.counts)
    grid = np.unique(np.quantile(values[rows], np.linspace(0.002, 0.998, SETTINGS.maps.table_points)))
    design = hats(values[rows], grid)
    stretch = (rows // max(1, round(1.0 / predictor.traces[0].period_s))) % 2 == 0
    share = 0.0
    for part in (stretch, ~stretch):
        predicted = design[~part] @ _ridge(design[part], mismatch[rows][part])
        left = mismatch[rows][~part] - predicted
        share += 0.5 * (1.0 - float(left @ left) / max(float(np.sum(mismatch[rows][~part] ** 2)), 1e-30))
    return ResidualTable(name, grid, -_ridge(design, mismatch[rows]), share)


def _ridge(design: Array, wanted: Array) -> Array:
    normal = design.T @ design
    return np.asarray(np.linalg.solve(normal + 1e-6 * np.trace(normal) * np.eye(len(normal)), design.T @ wanted))


def hats(values: Array, grid: Array) -> Array:
    """Piecewise linear basis on `grid`, zero outside."""
    place = np.clip(np.searchsorted(grid, values, side="right") - 1, 0, len(grid) - 2)
    share = (values - grid[place]) / (grid[place + 1] - grid[place])
    inside = (values >= grid[0]) & (values <= grid[-1])
    design = np.zeros((len(values), len(grid)))
    row = np.arange(len(values))
    design[row, place] = np.where(inside, 1.0 - share, 0.0)
    design[row, place + 1] = np.where(inside, share, 0.0)
    return design
