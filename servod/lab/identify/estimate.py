"""An identified number with its 95 % interval, and the statistics behind such intervals.

Under every fit. Intervals come from the scatter between parts of the data (delete-one jackknife over parts, or the
cluster-robust sandwich of a linear regression), widened by a stated share for what no scatter shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]
Part = TypeVar("Part")

#: Two-sided 95 %.
LEVEL = 0.975


@dataclass(frozen=True)
class Estimate:
    """A value and its 95 % interval; `note` says what was hit or assumed, empty when nothing."""

    value: float
    low: float
    high: float
    unit: str
    note: str = ""

    def holds(self, truth: float) -> bool:
        """Whether the interval covers `truth`."""
        return self.low <= truth <= self.high

    @property
    def half_width(self) -> float:
        """Half of the interval."""
        return 0.5 * (self.high - self.low)


def estimate(
    value: float, deviation: float, freedom: float, unit: str, share: float = 0.0, floor: float = 0.0, note: str = ""
) -> Estimate:
    """Interval of a value from its standard deviation and degrees of freedom.

    `share` (of the value) and `floor` (in its unit) are half widths for what the scatter does not show; they add in
    quadrature.
    """
    half = math.hypot(float(stats.t.ppf(LEVEL, max(freedom, 1.0))) * deviation, share * abs(value), floor)
    return Estimate(value, value - half, value + half, unit, note)


def jackknife(fit: Callable[[Sequence[Part]], Array], parts: Sequence[Part]) -> tuple[Array, Array]:
    """(values, standard deviations) of `fit` without one of `parts` at a time (Efron, Tibshirani 1993, 11)."""
    whole = fit(parts)
    n = len(parts)
    left_out = np.array([fit([*parts[:i], *parts[i + 1 :]]) for i in range(n)])
    spread = left_out - left_out.mean(axis=0)
    return whole, np.sqrt((n - 1) / n * np.sum(spread**2, axis=0))


def sandwich(design: Array, residual: Array, weights: Array, clusters: NDArray[np.int64]) -> Array:
    """Cluster-robust covariance of a weighted linear regression (Liang and Zeger, Biometrika 73, 1986).

    `clusters` numbers the part of the data that each row belongs to; corrected for few clusters.
    """
    weighted = design * weights[:, None]
    bread = np.linalg.pinv(weighted.T @ design)
    score = weighted * residual[:, None]
    order = np.argsort(clusters, kind="stable")
    starts = np.flatnonzero(np.diff(clusters[order], prepend=clusters[order[0]] - 1))
    sums = np.add.reduceat(score[order], starts, axis=0)
    count = len(starts)
    covariance: Array = bread @ (sums.T @ sums) @ bread * (count / max(count - 1, 1))
    return covariance


# --- Ends of ranges --------------------------------------------------------------------------------------------------
# Ranges of searches: a number that stands at the end of its range was not found there, and says so. Fits that are
# linear have no ranges.


#: The note of such a number.
AT_END = "at the end of its range"
#: Closer to a bound than this share of its range is on it.
ON_BOUND = 1e-3


def bound_notes(values: Sequence[float], low: Sequence[float], high: Sequence[float]) -> tuple[str, ...]:
    """A note for each of `values` that a search between `low` and `high` left at an end, empty for the others."""
    shares = [(v - a) / (b - a) for v, a, b in zip(values, low, high, strict=True)]
    return tuple(AT_END if share < ON_BOUND or share > 1.0 - ON_BOUND else "" for share in shares)


def joined(*notes: str) -> str:
    """Notes of one number as one."""
    return "; ".join(note for note in notes if note)
