"""What a term is worth, and from when on that is worth a name.

Stands beside the selection; the levels are those of the outside contract and what experience added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


#: What a term whose own torque counts changes at least beside parameters fitted again, as a share of dry friction.
LEAST_BESIDE = 0.01


@dataclass(frozen=True)
class Merit:
    """What a term is worth: its share of the explainable error, its torque as a share of dry friction, its cost gain.

    `gain` is twice the cost that it saves, in units of noise that counts correlated rows as one; `of_left` its share of
    what the fit before it had left above the noise floor. `torque` is what the term changes beside parameters fitted
    again, `own` what it changes beside the same ones.
    """

    share: float
    of_left: float
    torque: float
    gain: float
    own: float = 0.0


def worth_naming(merit: Merit, level: bool) -> bool:
    """Whether a term is worth a name; `level`: it is a parameter of the model's own beyond its level.

    One that takes blows alone, and leaves all rows between them as they were or worse, is not what they are made of.
    """
    least = SETTINGS.worth.level_torque if level else SETTINGS.worth.least_torque
    much = merit.share >= SETTINGS.worth.sure_share and merit.of_left > 0.0
    rest = merit.of_left >= SETTINGS.worth.least_of_left or much
    acts = merit.torque >= (min(least, LEAST_BESIDE) if _own_counts(merit) else least)
    return large_enough(merit, level) and acts and rest


def large_enough(merit: Merit, level: bool) -> bool:
    """Whether a term has the size from which the outside contract calls it worth naming; `level` as above."""
    if merit.share >= SETTINGS.worth.share or merit.torque >= (
        SETTINGS.worth.level_torque if level else SETTINGS.worth.torque
    ):
        return True
    return _own_counts(merit)


def _own_counts(merit: Merit) -> bool:
    """Whether the torque that a term stands for counts, not what it changes beside parameters fitted again."""
    return merit.own >= SETTINGS.worth.torque and merit.of_left >= SETTINGS.worth.nearly_all


def acting_torque(changed: Array) -> float:
    """What an effect changes where it acts, N*m: a high quantile, or the root mean square weighted by power.

    A wave has as much of both; a push of a second, or blows behind reversals, have next to nothing at a quantile.
    """
    power = float(changed @ changed)
    weighted = math.sqrt(float(np.sum(changed**4)) / power) if power > 0.0 else 0.0
    return max(float(np.quantile(changed, SETTINGS.worth.acts_at)), weighted)
