"""The state of a selection, which each stage takes and returns: fits, and for each term its worth and how it came in.

Stands below the stages (`stepwise`, `cross_validation`) and above the fit; plain values, nothing decided.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.result import MinorReason
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]


@dataclass(frozen=True)
class TermEntry:
    """How a term came in: what it left of the cost as a share, and the other candidates."""

    left: float
    rivals: tuple[Candidate, ...]


@dataclass(frozen=True)
class Folds:
    """Rows that are left out together, what they are in words, and the rows by which fits are judged."""

    parts: tuple[Rows, ...]
    left_out: str
    judged: Rows


@dataclass(frozen=True)
class Fold:
    """Rows that were left out together, and what was fitted without them: a model for all recordings or for each."""

    rows: Rows
    models: tuple[AxisModel, ...]

    def of(self, recording: int) -> AxisModel:
        """The model of a recording."""
        return self.models[recording if len(self.models) > 1 else 0]


@dataclass(frozen=True)
class HeldOutErrors:
    """Mismatch (N*m) of every row by a fit that has not seen it; `rms` is over the rows that are judged.

    `coordinates` are those of each fold's fit.
    """

    mismatch: Array
    rms: float
    folds: tuple[Fold, ...] = ()
    coordinates: tuple[Array, ...] = ()


@dataclass(frozen=True)
class CrossValidation:
    """Errors on rows that the fits have not seen: of the base, of all terms, and without each of those to be named.

    `named` are places of terms whose effect is at its level, `reduced` the fits to everything without each of them.
    """

    named: tuple[int, ...]
    reduced: Mapping[int, Fit]
    folds: Folds
    before: HeldOutErrors
    after: HeldOutErrors
    without: Mapping[int, HeldOutErrors]


@dataclass(frozen=True)
class Selection:
    """What is selected so far: the fit with all terms, the fit of the base alone, and for each term how it came in.

    `floor` is the noise floor as a mean square, `base_error` that of the base's mismatch; `minor` are effects that are
    significant and not worth a name, `rejected` those that came in and had to go again, and why. `tried` counts starts
    of effects; `cut`: time ended the search while something was left.
    """

    base: Fit
    fit: Fit
    base_error: float
    floor: float
    merits: tuple[Merit, ...] = ()
    entries: tuple[TermEntry, ...] = ()
    minor: Mapping[str, Merit] = field(default_factory=dict)
    rejected: Mapping[str, tuple[Merit, MinorReason]] = field(default_factory=dict)
    tried: int = 0
    cut: bool = False
    validation: CrossValidation | None = None

    @property
    def terms(self) -> int:
        """How many terms are in."""
        return len(self.fit.hypothesis.terms)

    def with_term(self, fit: Fit, merit: Merit, entry: TermEntry) -> Selection:
        """This selection and one term more, the last of `fit`."""
        return replace(self, fit=fit, merits=(*self.merits, merit), entries=(*self.entries, entry))

    def without_term(self, index: int, reduced: Fit) -> Selection:
        """This selection less one term; `reduced` is the fit without it."""
        merits = self.merits[:index] + self.merits[index + 1 :]
        return replace(self, fit=reduced, merits=merits, entries=self.entries[:index] + self.entries[index + 1 :])

    def with_merit(self, index: int, merit: Merit) -> Selection:
        """This selection with the worth of one term said again."""
        return replace(self, merits=(*self.merits[:index], merit, *self.merits[index + 1 :]))
