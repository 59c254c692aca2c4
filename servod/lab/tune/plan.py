"""What a tuning is: its class, its budget and limits, and its result.

Stands under the optimiser; everything here is plain values that go to worker processes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from servod.formats.gains.gain_set import GainSet
from servod.lab.simulate.simulate import LoopSettings

#: Inner step of a search: errors come out within 3 % of those at half of it, in half the time.
SEARCH_STEP_S = 1e-4


#: Simulated plants for each law and class: 180 sets of gains on three plants, 8 s of one core. PD + LuGre shares it
#: among three searches: with each of the paper's two l_f, and with l_f tuned, which starts where those ended.
BUDGET = 540


#: The limit on roughness is a price in the search's cost: a set that was tuned to it may stand this share above.
ROUGHNESS_TOLERANCE = 0.01


class Feedback(Enum):
    """Classes of the comparison: the paper's PD gains for every law, or PD gains tuned with the rest."""

    EQUAL = "equal"
    FREE = "free"


@dataclass(frozen=True, slots=True)
class TuningSettings:
    """What is the same for every law of a comparison; defaults are the paper's axis.

    `budget` is the number of plants that one law may simulate in one class in all its searches together, `plants` of
    them for each set of gains that is tried; `seed` begins plants, noise and search (scoring takes another).
    `roughness_limit` bounds the RMS of the torque's change from cycle to cycle, as a multiple of what the paper's PD
    gains make of encoder steps and noise on the same plants: an absolute figure would favour fine encoders and large
    axes. Five times is what the paper's own LuGre observer with l_f 0.25 makes, which ran on a joint; beyond that a
    drive hears encoder, not friction.
    """

    budget: int = BUDGET
    plants: int = 3
    seed: int = 1
    counts_per_turn: float = 2.0**20
    cutoff_hz: float = 300.0
    period_s: float = 0.001
    torque_limit_nm: float = math.inf
    speed_max_rad_s: float = 0.5
    roughness_limit: float = 5.0

    @property
    def loop(self) -> LoopSettings:
        """What stands around the law in the simulator."""
        return LoopSettings(
            self.period_s, self.counts_per_turn, self.cutoff_hz, self.torque_limit_nm, inner_step_s=SEARCH_STEP_S
        )


@dataclass(frozen=True, slots=True)
class Tuned:
    """A tuned gain set, not certified. `cost` is what the search made least, in mrad (servod.lab.tune.tuning).

    `simulations` is what its search spent; `roughness` a multiple of the paper's PD, beyond the plan's limit only where
    even the smoothest set of the law is. `values` are the numbers it was built from, by the names of
    servod.lab.tune.laws.
    """

    gains: GainSet
    cost: float
    simulations: int
    roughness: float
    values: dict[str, float]
