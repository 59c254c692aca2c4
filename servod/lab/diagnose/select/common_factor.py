"""The common factor on every torque of an axis, which no recording tells beside an unknown gain.

Stands beside the fit. A drive that makes k times the torque, on a joint k times as heavy with k times the friction,
makes the same motion: along this line the data are flat, and what was believed beforehand says alone where on it a fit
ends. Derivatives over a span see a slope there that is none, and a fit stopped wherever it had come from.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.base import TORQUES
from servod.lab.diagnose.effects.hypothesis import Hypothesis, Unknown

Array = NDArray[np.float64]


def along_factor(hypothesis: Hypothesis, coordinates: Array) -> Array | None:
    """By how much each coordinate grows with the logarithm of the factor; None where no term leaves it open."""
    gains = [index for index, term in enumerate(hypothesis.terms) if effect(term.effect).scales_torques]
    if not gains:
        return None
    torques = np.array([_is_torque(unknown) for unknown in hypothesis.unknowns])
    for index in gains:
        torques[hypothesis.share(index)] = True
    return np.where(torques, np.where(_straight(hypothesis), coordinates, 1.0), 0.0)


def _is_torque(unknown: Unknown) -> bool:
    return unknown.key in TORQUES or unknown.unit.startswith("N")


def _straight(hypothesis: Hypothesis) -> NDArray[np.bool_]:
    """Coordinates that are multiples of a size; the others are logarithms."""
    return np.array([unknown.size != 0.0 for unknown in hypothesis.unknowns])


def believed_factor(hypothesis: Hypothesis, coordinates: Array) -> Array | None:
    """The coordinates with the factor where it was believed beforehand, within bounds; None where nothing is open."""
    along = along_factor(hypothesis, coordinates)
    if along is None:
        return None
    (centre, precision), (low, high) = hypothesis.prior, hypothesis.bounds
    weight = precision**2 * along
    some = along != 0.0
    ends = np.sort([(low - coordinates)[some] / along[some], (high - coordinates)[some] / along[some]], axis=0)
    if not weight.any() or ends[0].max() > ends[1].min():
        return None
    best = -float(weight @ (coordinates - centre)) / float(weight @ along)
    factor = float(np.clip(best, ends[0].max(), ends[1].min()))
    moved = coordinates + factor * along
    return np.where(_straight(hypothesis) & some, coordinates * np.exp(factor), moved)
