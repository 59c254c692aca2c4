"""What one drawing of a concealed effect consists of; shared by the files that draw.

Stands between axes and the drawings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from servod.qualify.blind.axes import CaseAxis
from servod.qualify.blind.physics import Physics

Document = dict[str, Any]

#: Share of the axes without a thermometer, whatever they conceal: that temperatures are missing must tell nothing.
NO_THERMOMETER = 0.3


@dataclass(frozen=True)
class Concealed:
    """One effect on one axis.

    `changes` are the plant's numbers; `parameters` what a diagnosis should find, by the names that `servoctl explain`
    prints; `model` the groups of an axis model file that say the same, None where such a file has no words for it;
    `believed` what the model that the user has says otherwise; `travel` the least travel (rad) that shows the effect;
    `only` the one recording in which it happens; `thermometer` whether temperature must or must not be recorded, for
    parameters that are told of it, None where that is left to chance; `cold` whether each recording starts cold.
    """

    changes: Mapping[str, float]
    parameters: Mapping[str, float] = field(default_factory=dict)
    model: Document | None = None
    believed: Mapping[str, float] = field(default_factory=dict)
    travel: float = 0.0
    only: int | None = None
    thermometer: bool | None = None
    cold: bool = False


@dataclass(frozen=True)
class Draw:
    """With what an effect is drawn: the axis, chance, a factor on the usual size, and whether in another form."""

    axis: CaseAxis
    rng: np.random.Generator
    strength: float
    other: bool

    @property
    def physics(self) -> Physics:
        """The axis's own."""
        return self.axis.physics

    def size(self, low: float, high: float) -> float:
        """A size between two usual ones, evenly on a logarithmic scale, times the strength."""
        return self.strength * float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def between(self, low: float, high: float) -> float:
        """A number between two others, whatever the strength."""
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        """1 or -1."""
        return float(self.rng.choice([-1.0, 1.0]))

    def one_of(self, *values: float) -> float:
        """One of some values."""
        return float(self.rng.choice(values))

    def flip(self) -> bool:
        """Heads or tails."""
        return bool(self.rng.uniform() < 0.5)
