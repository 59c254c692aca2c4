"""What a diagnosis found, as plain results: the evidence of each effect, what was kept, and the whole.

Filled by the engine; document and page format it and compute nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import Refusal
from servod.lab.diagnose.data.trace import Trace
from servod.lab.diagnose.judge.held_out import HeldOut, Split
from servod.lab.diagnose.judge.locate import Map
from servod.lab.diagnose.judge.unnamed import Unnamed
from servod.lab.diagnose.judge.verdict import Shares, Verdict
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.choice import Choice
from servod.lab.diagnose.select.fit import Fit

if TYPE_CHECKING:
    pass

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Diagnosis:
    """What was found; without any recording that can tell there is no evidence."""

    nominal: AxisModel
    refused: list[Refusal]
    verdict: Verdict
    evidence: Evidence | None
    seconds: dict[str, float]


@dataclass(frozen=True)
class Evidence:
    """Everything behind a verdict on recordings that can tell.

    `named` are places of terms in the fit and `less` the fits without each of them; `errors` are those of the fits to
    everything, by which names are judged. `before`, `after` and `without` are by fits that have not seen the rows of
    `shared`, and `unseen` has the errors of these. `attempt` is the share of the explainable error that known physics
    removes there, also where its names may not stand. `kept` says of terms in the fit why they are no findings.
    """

    traces: tuple[Trace, ...]
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


class Kept(StrEnum):
    """Why a term that stays in the model is no finding."""

    LEVEL = "below the level from which its effect counts"
    TWIN = "told together with its longer twin"
    SMALL = "below the smallest size worth a name"
    UNSURE = "not told from none"
    AT_END = "a number of it lies at the end of its range"
