"""How far estimates may be off: noise, recordings that disagree, what only prior knowledge fixes, error of the model.

Stands between the fit and the intervals of the document. The noise's share (`fit.covariance`) alone promises too much:
recordings of 46 000 rows make it tiny, and what is left of a recording is never noise alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.base import RECALIBRATION
from servod.lab.diagnose.select.common_factor import along_factor
from servod.lab.diagnose.select.fit import Fit, Weighing, covariance, on_bound
from servod.lab.diagnose.select.selection import HeldOutErrors
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

#: The bristle's stiffness and damping, which act for some samples at a time.
BRISTLE = ("friction.sigma0", "friction.sigma1")


def total_covariance(fit: Fit, weighing: Weighing, period_s: float, held: HeldOutErrors) -> Array:
    """Covariance of the coordinates of `fit`; `held` has the fits without each recording."""
    return covariance(fit, weighing, period_s) + jackknife(fit, held) + model_error(fit) + common_factor(fit)


def bounded_error(fit: Fit) -> Array:
    """Of a coordinate on its bound nothing is known but its range: half of that is one standard deviation."""
    low, high = fit.hypothesis.bounds
    return np.diag(np.where(on_bound(fit), 0.5 * (high - low), 0.0) ** 2)


def jackknife(fit: Fit, held: HeldOutErrors) -> Array:
    """By how much the fits without each recording disagree (Efron, The Jackknife, 1982)."""
    count, size = len(held.coordinates), len(fit.coordinates)
    if count < 2:
        return np.zeros((size, size))
    off = np.array([other - fit.coordinates for other in held.coordinates])
    return np.asarray((count - 1) / count * off.T @ off)


def model_error(fit: Fit) -> Array:
    """Error of the model in each value, more for the bristle; of a sine by its term's size, of orders by the range."""
    sizes = np.array(
        [SETTINGS.intervals.bristle_error if unknown.key in BRISTLE else 1.0 for unknown in fit.hypothesis.unknowns]
    )
    linear = np.array([unknown.size != 0.0 for unknown in fit.hypothesis.unknowns])
    sizes[linear] = np.abs(fit.coordinates[linear])
    for index, term in enumerate(fit.hypothesis.terms):
        waves = [u.key.startswith(("sine", "cosine")) for u in term.unknowns]
        some = np.arange(len(sizes))[fit.hypothesis.share(index)][np.array(waves, dtype=bool)]
        sizes[some] = np.linalg.norm(fit.coordinates[some])
        orders = [u.key == "n" for u in term.unknowns]
        sizes[np.arange(len(sizes))[fit.hypothesis.share(index)][np.array(orders, dtype=bool)]] = 1.0
    return np.diag((SETTINGS.intervals.model_error * sizes) ** 2)


def common_factor(fit: Fit) -> Array:
    """With an unknown gain, the common factor on every torque of the axis is as well known as beforehand.

    A model's numbers come of one identification: what was wrong with its torques is wrong in all of them, and is
    anything up to what is still recalibration.
    """
    size = len(fit.coordinates)
    along = along_factor(fit.hypothesis, fit.coordinates)
    if along is None:
        return np.zeros((size, size))
    return np.asarray(np.outer(along, along) * RECALIBRATION**2 / 3.0)


def inside_region(off: Array, spread: Array) -> bool:
    """Whether coordinates that are off by so much lie in the region of 95 % of this covariance."""
    from scipy.stats import chi2

    distance = float(off @ np.linalg.pinv(spread, hermitian=True) @ off)
    return distance <= float(chi2.ppf(SETTINGS.intervals.region, len(off)))
