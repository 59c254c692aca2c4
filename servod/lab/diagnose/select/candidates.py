"""Tries every effect on what the present fit leaves: a step or two for all starts, full fits for the best.

Stands between the effects' files and the selection. First rounds run on shortened data and reuse the Jacobian of the
present fit for what they have in common with it, so that a start costs a few short simulations only.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects import effect, effects
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import in_parallel
from servod.lab.diagnose.select.fit import Fit, Fitter
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

#: Forms of one effect are alike on shortened data where what they leave differs by less than this share of it, or of
#: what was there: next to nothing is as good as nothing.
ALIKE, ALIKE_OF_ALL = 0.15, 0.01


@dataclass(frozen=True)
class Candidate:
    """An effect on trial: its fit, and what is left of the cost of the present fit as a share of it.

    `term_index` is that of its own term in the fit: the last, unless others came in behind it.
    """

    effect: str
    fit: Fit
    left: float
    term_index: int = -1

    @property
    def term(self) -> Term:
        """The effect in the form that was fitted."""
        return self.fit.hypothesis.terms[self.term_index]

    @property
    def own(self) -> Array:
        """Coordinates of the term's own unknowns."""
        return self.fit.coordinates[self.fit.hypothesis.share(self.term_index)]


class CandidateFits:
    """Fits candidates against one present fit: `short` works on shortened data, `whole` on everything."""

    def __init__(
        self, whole: Fitter, short: Fitter, present: Fit, scene: SearchContext, nominal: bool, deadline: float
    ) -> None:
        self.whole, self.short, self.present, self.scene, self.deadline = whole, short, present, scene, deadline
        self.tried = 0
        self.beside = self._with_jacobian(short.begin(present.hypothesis, present.coordinates))
        self.from_nominal = self._with_jacobian(short.begin(present.hypothesis)) if nominal else None

    def _with_jacobian(self, fit: Fit | None) -> Fit:
        if fit is None:
            raise ValueError("a hypothesis that makes no sense at its start")
        return replace(fit, jacobian=self.short.derivatives(fit))

    def run(self, skip: Iterable[str] = ()) -> list[Candidate]:
        """Candidates fitted to the end, best first, then the others; effects in `skip` are not tried."""
        names = [what.name for what in effects() if what.name not in skip]
        first = [c for found in in_parallel("starts", self._starts, names) for c in found]
        first.sort(key=lambda c: c.left)
        second = in_parallel("starts", self._second_round, best_of_each(first, SETTINGS.trials.second_round, 2))
        second.sort(key=lambda c: c.left)
        chosen = best_of_each(second, len(second), 1)
        limit = chosen[0].left + SETTINGS.trials.in_reach * max(1.0 - chosen[0].left, 0.0) if chosen else 0.0
        close = [c for c in chosen if c.left <= limit][: SETTINGS.trials.full_fits]
        close += [c for c in second if any(_alike(c, other) for other in close)]
        fitted = sorted(in_parallel("starts", self._fit_fully, close), key=penalised_left)
        fitted = best_of_each(fitted, len(fitted), 1)
        return fitted + [c for c in chosen if c.effect not in {f.effect for f in fitted}]

    def _starts(self, name: str) -> list[Candidate]:
        """All starts of an effect after one step each."""
        what = effect(name)
        begun = [fit for term in what.terms(self.scene) for fit in self._begin(term, what.far)]
        self.tried += len(begun)
        if what.far:
            begun = sorted(begun, key=self.short.predicted_cost)[: SETTINGS.trials.far_starts]
        begun = [self.short.refresh_opened(fit) for fit in begun]
        return [self._on_short_data(name, self.short.refine(fit, 1, fit.jacobian.shape[1], 2), fit) for fit in begun]

    def _begin(self, term: Term, far: bool) -> list[Fit]:
        """The term beside the present fit, and for far effects beside the nominal model."""
        froms = [self.beside] + ([self.from_nominal] if far and self.from_nominal is not None else [])
        fits = []
        for beside in froms:
            hypothesis = beside.hypothesis.with_term(term)
            fits.append(self.short.begin(hypothesis, hypothesis.beside(beside.coordinates), beside.jacobian))
        return [fit for fit in fits if fit is not None]

    def _on_short_data(self, name: str, fit: Fit, begun: Fit) -> Candidate:
        """A candidate on shortened data; it shares the Jacobian it began with, for many are kept."""
        return Candidate(name, replace(fit, jacobian=begun.jacobian), fit.cost / max(self.beside.cost, 1e-30))

    def _second_round(self, candidate: Candidate) -> Candidate:
        fit = candidate.fit
        return self._on_short_data(
            candidate.effect, self.short.refine(fit, SETTINGS.trials.second_steps, fit.jacobian.shape[1]), fit
        )

    def _fit_fully(self, candidate: Candidate) -> Candidate:
        """Fit on everything, as long as there is time."""
        begun = self.whole.begin(candidate.fit.hypothesis, candidate.fit.coordinates, self.present.jacobian)
        if begun is None or monotonic() > self.deadline:
            return candidate
        fit = self.whole.refine(
            self.whole.refresh_opened(begun), SETTINGS.trials.full_steps, known=self.present.jacobian.shape[1]
        )
        return Candidate(candidate.effect, fit, fit.cost / max(self.present.cost, 1e-30))


def _alike(one: Candidate, other: Candidate) -> bool:
    """Whether another form of the same effect does as well on shortened data, which do not tell what time does.

    A push in one recording and one in every recording are the same where the others were cut.
    """
    forms = one.effect == other.effect and one.term.form != other.term.form
    near = max(ALIKE * max(one.left, other.left), ALIKE_OF_ALL)
    return forms and effect(one.effect).look.coordinate == "time" and abs(one.left - other.left) <= near


def penalised_left(candidate: Candidate) -> float:
    """What is left, a little more for every number that the term needs: the plainest of equals comes first."""
    return candidate.left * (1.0 + SETTINGS.trials.per_number * candidate.term.numbers)


def best_of_each(sorted_candidates: list[Candidate], count: int, each: int) -> list[Candidate]:
    """The first `count` candidates with at most `each` of the same effect."""
    kept: list[Candidate] = []
    for candidate in sorted_candidates:
        if sum(other.effect == candidate.effect for other in kept) < each:
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept
