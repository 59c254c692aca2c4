"""A selection as it is judged: which of its terms are findings, by errors on rows that the fits have not seen.

Stands between cross-validation and the verdict; `conclude` makes the plain result of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.judge.held_out import HeldOut, Split
from servod.lab.diagnose.judge.verdict import Shares
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import Kept, Map, Unnamed
from servod.lab.diagnose.select.choice import Choice
from servod.lab.diagnose.select.fit import Fit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Judgement:
    """Everything that was judged of a selection, on recordings that can tell.

    `named` are places of terms in the fit and `less` the fits without each of them; `errors` are those of the fits to
    everything, by which names are judged. `before`, `after` and `without` are by fits that have not seen the rows of
    `shared`, and `unseen` has the errors of these. `attempt` is the share of the explainable error that known physics
    removes there, also where its names may not stand. `kept` says of terms in the fit why they are no findings.
    """

    predictor: Predictor
    choice: Choice
    named: list[int]
    errors: Shares
    spread: Array
    less: dict[int, Fit]
    shared: Split
    unseen: Shares
    before: HeldOut
    after: HeldOut
    without: dict[int, HeldOut]
    unnamed: Unnamed | None
    maps_before: list[Map]
    maps_after: list[Map]
    attempt: float
    kept: Mapping[int, Kept] = field(default_factory=dict)

    @property
    def fit(self) -> Fit:
        """The fit that stands."""
        return self.choice.fit

    def carries(self, place: int) -> float:
        """The share of the explainable error on unseen rows that a named term removes."""
        unseen = self.unseen
        without = float(np.mean(self.without[place].mismatch[self.predictor.counts] ** 2))
        return max(without - unseen.after**2, 0.0) / max(unseen.before**2 - unseen.floor**2, 1e-30)
