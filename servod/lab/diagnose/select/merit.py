"""What a term is worth, and from when on that is worth a name.

Stands beside the selection; the levels are those of the outside contract and what experience added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Worth naming (outside contract): share of the explainable error, or share of Coulomb friction where it acts; and the
#: least torque that any finding must carry there, which several effects of one per cent each stay below.
WORTH_SHARE, WORTH_TORQUE, LEAST_TORQUE = 0.05, 0.03, 0.018

#: The least torque of a parameter beyond its own level, which acts for some milliseconds behind a reversal.
LEVEL_TORQUE = 0.003

#: A term that takes less than SURE_SHARE must take this share of what is left above the floor: a name that leaves most
#: of the rest as it was is not what the rest is made of.
LEAST_OF_LEFT = 0.25

#: A term that takes this share of what is left is what the rest is made of: then the torque that it stands for counts,
#: for what a scale on the model's own friction and inertia cannot take up of it may be little.
NEARLY_ALL = 0.8

#: Rows that show where an effect acts: its torque there is at least this quantile of what it changes.
ACTS_AT = 0.98

#: A fit that takes so much of the explainable error counts though its last steps still improved it.
SURE_SHARE = 0.3


@dataclass(frozen=True)
class Merit:
    """What a term is worth: its share of the explainable error, its torque as a share of dry friction, its cost gain.

    `gain` is twice the cost that it saves, in units of noise that counts correlated rows as one; `of_left` its share of
    what the fit before it had left above the noise floor. `torque` is what the term changes beside parameters fitted
    anew, `own` what it changes beside the same ones.
    """

    share: float
    of_left: float
    torque: float
    gain: float
    own: float = 0.0


def worth_naming(merit: Merit, level: bool) -> bool:
    """Whether a term is worth a name; `level`: it is a parameter of the model's own beyond its level."""
    least = LEVEL_TORQUE if level else LEAST_TORQUE
    rest = merit.of_left >= LEAST_OF_LEFT or merit.share >= SURE_SHARE
    return of_size(merit, level) and merit.torque >= least and rest


def of_size(merit: Merit, level: bool) -> bool:
    """Whether a term has the size from which the outside contract calls it worth naming; `level` as above."""
    if merit.share >= WORTH_SHARE or merit.torque >= (LEVEL_TORQUE if level else WORTH_TORQUE):
        return True
    return merit.own >= WORTH_TORQUE and merit.of_left >= NEARLY_ALL


def acting(changed: Array) -> float:
    """What an effect changes where it acts, N*m: a high quantile, or the root mean square weighted by power.

    A wave has as much of both; a push of a second, or blows behind reversals, have next to nothing at a quantile.
    """
    power = float(changed @ changed)
    weighted = math.sqrt(float(np.sum(changed**4)) / power) if power > 0.0 else 0.0
    return max(float(np.quantile(changed, ACTS_AT)), weighted)
