"""Parameters of the model that have a level of their own: pulled beyond it they are findings, however little they move.

Stands beside the selection (`choose`), which else looks for more only while something worth naming is left. A softer
bristle or a steeper Stribeck curve acts for some milliseconds behind each reversal and is nothing on average.
"""

from __future__ import annotations

from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.select.fit import Fit

#: Parameters that the outside contract gives a level, which is their bound until a term opens it.
LEVELS = frozenset(
    ("friction.static", "friction.stribeck_velocity", "friction.sigma0", "friction.sigma1", "torque_offset", "inertia")
)

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
