"""What a term is worth, and from when on that is worth a name.

Stands beside the selection; the levels are those of the outside contract and what experience added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.base import LEVELS
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.select.fit import Fit

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


# Parameters of the model that have a level of their own: pulled beyond it they are findings, however little they move.
#
# Stands beside the selection (`choose`), which else looks for more only while something worth naming is left. A softer
# bristle or a steeper Stribeck curve acts for some milliseconds behind each reversal and is nothing on average.


#: Own numbers of such terms that have no level: damping that fades with speed is judged by the torque that it makes.
NO_LEVEL = frozenset(("damping_velocity",))

#: A coordinate so near to its bound stands on it.
ON_BOUND = 1e-6


def on_bound(fit: Fit) -> bool:
    """Whether a parameter with a level stands on its bound: the data pull it further.

    The Stribeck velocity has none; it opens together with static friction.
    """
    low, high = fit.hypothesis.bounds
    watched = LEVELS - {"friction.stribeck_velocity"}
    places = [i for i, unknown in enumerate(fit.hypothesis.base) if unknown.key in watched]
    return any(min(fit.coordinates[i] - low[i], high[i] - fit.coordinates[i]) < ON_BOUND for i in places)


def is_level(term: Term) -> bool:
    """Whether a term opens parameters that have a level, and no others."""
    own = {unknown.key for unknown in term.unknowns}
    return bool(term.opens) and LEVELS.issuperset(term.opens) and not own & NO_LEVEL


# Whether a fitted effect says itself that it is something else: one of its own numbers lies at an end of its range.
#
# Stands between the fit and the selection. Ranges are wide, what is physical lies within: an optimum at an end, twenty
# times the mass or ten times the friction at rest, borrows a shape from an effect that is not there.


#: Numbers that may lie at an end of their range: where they do not matter, or are known beforehand to a narrow one.
#: A bristle's damping is one of them, the model's own as well as that of a bristle that the model does not have.
MAY_END = frozenset(
    (
        *("damping", "cubic", "exponent", "delay_s", "sigma1", "friction.sigma1"),
        *("friction.stribeck_velocity", "damping_velocity"),
    )
)

#: Coordinates that are so close to an end lie on it.
CLOSE = 1e-6


def at_end(fit: Fit, place: int = -1) -> bool:
    """Whether a number of a term (the last), or one of the model's own that it opens, lies at an end of its range.

    An end where the number is zero is none: there the effect is just absent.
    """
    term, unknowns = fit.hypothesis.terms[place], fit.hypothesis.unknowns
    low, high = fit.hypothesis.bounds
    share = fit.hypothesis.share(place)
    for index, (unknown, at) in enumerate(zip(unknowns, fit.coordinates, strict=True)):
        own = share.start <= index < share.stop or unknown.key in term.opens
        if not own or unknown.key in MAY_END:
            continue
        ends = [end for end, value in ((low[index], unknown.low), (high[index], unknown.high)) if value != 0.0]
        if any(abs(float(at) - float(end)) < CLOSE for end in ends):
            return True
    return False
