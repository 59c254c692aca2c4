"""How fast the output observer may be in Omega_L while the reference moves, tried on simulated plants.

Stands after the search for bandwidths that are stable. A fast observer tracks best, yet where friction turns over it
has taken the old direction for a disturbance, and may throw the joint forward: no pole shows that, a slow sine does.
"""

from __future__ import annotations

import math

from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters
from servod.lab.synthesize.observer_width import Search, with_observer
from servod.lab.verify.checks import DISK_LIMIT
from servod.lab.verify.steady_friction import SteadyFriction
from servod.lab.verify.trials import ERROR_SHARE, monte_carlo

PLANTS, SEED = 20, 11  # of the trial; the certificate draws others, and many more
#: Largest error of the sine on these plants as a share of what the certificate allows: it meets worse ones.
TRIED_SHARE = 0.5


def with_moving_observer(gains: GainSet, friction: SteadyFriction) -> GainSet:
    """`gains` with the bandwidth of coming to rest also in motion where that stands and follows; sealed."""
    law, design = gains.parameters, gains.design
    assert isinstance(law, LocalParameters) and law.disturbance_observer is not None and design is not None
    high, rest = law.disturbance_observer.bandwidth_rad_s, law.disturbance_observer.low_bandwidth_rad_s
    search = Search(design, friction)
    for moving in [rest, math.sqrt(rest * high)] if rest else []:
        faster = with_observer(law, high, rest, moving)
        found = gains.model_copy(update={"parameters": faster}).sealed()
        if follows(found) and search.stands(faster, DISK_LIMIT, law.regions.overlap_to_rad_s):
            return found
    return gains


def follows(gains: GainSet) -> bool:
    """Whether every plant of the trial follows the slow sine with something to spare."""
    tried = monte_carlo(gains, PLANTS, SEED, processes=1)
    return max(trial.error_share for trial in tried) < TRIED_SHARE * ERROR_SHARE
