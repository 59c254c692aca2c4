"""What a term is worth, and from when on that is worth a name.

Stands beside the selection; the levels are those of the outside contract and what experience added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


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
    least = SETTINGS.worth.level_torque if level else SETTINGS.worth.least_torque
    rest = merit.of_left >= SETTINGS.worth.least_of_left or merit.share >= SETTINGS.worth.sure_share
    return of_size(merit, level) and merit.torque >= least and rest


def of_size(merit: Merit, level: bool) -> bool:
    """Whether a term has the size from which the outside contract calls it worth naming; `level` as above."""
    if merit.share >= SETTINGS.worth.share or merit.torque >= (
        SETTINGS.worth.level_torque if level else SETTINGS.worth.torque
    ):
        return True
    return merit.own >= SETTINGS.worth.torque and merit.of_left >= SETTINGS.worth.nearly_all


def acting(changed: Array) -> float:
    """What an effect changes where it acts, N*m: a high quantile, or the root mean square weighted by power.

    A wave has as much of both; a push of a second, or blows behind reversals, have next to nothing at a quantile.
    """
    power = float(changed @ changed)
    weighted = math.sqrt(float(np.sum(changed**4)) / power) if power > 0.0 else 0.0
    return max(float(np.quantile(changed, SETTINGS.worth.acts_at)), weighted)


# Parameters of the model that have a level of their own: pulled beyond it they are findings, however little they move.
#
# Stands beside the selection (`choose`), which else looks for more only while something worth naming is left. A softer
# bristle or a steeper Stribeck curve acts for some milliseconds behind each reversal and is nothing on average.


#: Parameters that the outside contract gives a level, which is their bound until a term opens it.
LEVELS = frozenset(
    ("friction.static", "friction.stribeck_velocity", "friction.sigma0", "friction.sigma1", "torque_offset", "inertia")
)

#: Own numbers of such terms that have no level: damping that fades with speed is judged by the torque that it makes.
NO_LEVEL = frozenset(("damping_velocity",))


def on_bound(fit: Fit) -> bool:
    """Whether a parameter with a level stands on its bound: the data pull it further.

    The Stribeck velocity has none; it opens together with static friction.
    """
    low, high = fit.hypothesis.bounds
    watched = LEVELS - {"friction.stribeck_velocity"}
    places = [i for i, unknown in enumerate(fit.hypothesis.base) if unknown.key in watched]
    return any(min(fit.coordinates[i] - low[i], high[i] - fit.coordinates[i]) < SETTINGS.worth.on_bound for i in places)


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
        if any(abs(float(at) - float(end)) < SETTINGS.worth.on_bound for end in ends):
            return True
    return False
