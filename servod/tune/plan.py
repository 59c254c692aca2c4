"""What a tuning is: its class, its budget and limits, and its result.

Stands under the optimiser; everything here is plain values that go to worker processes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from servod.gains import GainSet


class Feedback(Enum):
    """Classes of the comparison: the paper's PD gains for every law, or PD gains tuned with the rest."""

    EQUAL = "equal"
    FREE = "free"


@dataclass(frozen=True, slots=True)
class TunePlan:
    """The same for every law of a comparison; defaults are the paper's axis.

    `budget` is the number of simulated plants that one law may spend in one class, `seed` begins plants, noise and
    the optimiser (scoring takes others). `roughness_limit` bounds the RMS of the torque's change from cycle to cycle,
    as a share of the largest friction.
    """

    budget: int = 400
    seed: int = 1
    counts_per_turn: float = 2.0**20
    cutoff_hz: float = 300.0
    period_s: float = 0.001
    torque_limit_nm: float = math.inf
    roughness_limit: float = 0.02


@dataclass(frozen=True, slots=True)
class Tuned:
    """A tuned gain set, not certified: `cost` is the objective reached (mrad), `roughness` the torque's, as a share."""

    gains: GainSet
    cost: float
    simulations: int
    roughness: float
