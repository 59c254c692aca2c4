"""What all stages of the selection share: fits on fixed recordings, and what the step from one to another is worth.

Stands between the candidates and the stages, and holds no state of the search: that is the `Selection`. A term stays
only while it is significant against correlated noise with a correction for the number of things tried, and worth naming
by the outside contract.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servod.common.progress import OnLine
from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects import effect, fitted_elsewhere, unexcited_effects
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.floor import above_noise, noise_floor, stretch_means
from servod.lab.diagnose.predict.predict import Predictor, fine_step_s, shorten
from servod.lab.diagnose.select.candidates import Candidate, CandidateFits
from servod.lab.diagnose.select.fit import Fit, Fitter, Weighing, follow, long_run, scale_of
from servod.lab.diagnose.select.levels import is_another, is_level_change
from servod.lab.diagnose.select.merit import Merit, acting_torque, worth_naming
from servod.lab.diagnose.select.selection import Selection
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

#: What every geared servo has, first of all.
SERVO = ("delay", "goal_rate", "load_dependent_friction")

#: Spans of the derivatives along which what is told is fitted, one after the other: fine ones of a rough mismatch end
#: the fit far from its end.
SPANS = 0.1, 0.03

#: Whether a new term deserves to come in, by what it is worth and the fit with it.
Deserves = Callable[[Merit, Fit], bool]


class Selector:
    """Fits and measures on fixed recordings; `deadline` is the monotonic time at which the search for terms ends.

    Keys in `unknown` are of the drive: their values in `nominal` are starts, and they are free.
    """

    def __init__(
        self,
        predictor: Predictor,
        nominal: AxisModel,
        deadline: float,
        on_progress: OnLine,
        unknown: frozenset[str] = frozenset(),
    ) -> None:
        self.predictor, self.deadline, self.on_progress = predictor, deadline, on_progress
        self.nominal, self.unknown = nominal, unknown
        self.start = Hypothesis(document_of(nominal), base_unknowns(nominal, unknown))
        self.untried = unexcited_effects(predictor.traces, nominal.inertia) | fitted_elsewhere(unknown)
        self.rows = predictor.counts.astype(np.float64)

    def finer(self, model: AxisModel) -> Selector:
        """The same with simulations as fine as a model asks for, for what is told: what is tried may be off a little.

        A bristle that turns by a radian within a step is another one, and parameters that make up for that are wrong.
        """
        step_s = fine_step_s(model)
        if step_s >= min(self.predictor.longest_step_s, *(trace.period_s for trace in self.predictor.traces)):
            return self
        predictor = Predictor(self.predictor.traces, self.nominal, self.predictor.rate, step_s)
        return Selector(predictor, self.nominal, self.deadline, self.on_progress, self.unknown)

    def refitted(self, selection: Selection) -> Selection:
        """The selection by this predictor, with its fits polished."""
        base = self.polished(selection.base)
        fit = base if selection.fit is selection.base else self.polished(selection.fit)
        error, floor = self.error(base.mismatch), noise_floor(self.predictor, base.mismatch)
        return self.lower_floor(replace(selection, base=base, fit=fit, base_error=error, floor=floor), fit.mismatch)

    def polished(self, fit: Fit) -> Fit:
        """A fit fitted on along derivatives over wide spans, then less wide ones, then along its valley.

        Its Jacobian is fresh.
        """
        begun = self.fitter(fit.mismatch).begin(fit.hypothesis, fit.coordinates)
        if begun is None:
            raise ValueError("a fit that makes no sense")
        for span in SPANS:
            begun = self._refined(replace(begun, span=span), begun.mismatch, 0)
        return self.refresh(self._along_valley(replace(begun, span=max(fit.span, SETTINGS.fit.wide))))

    def _along_valley(self, fit: Fit) -> Fit:
        """A fit moved to the bottom of its valley, in the scale of its own mismatch."""
        fitter = self.fitter(fit.mismatch)
        begun = replace(fit, cost=fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch))

        def refine(moved: Fit) -> Fit:
            return fitter.refine(replace(moved, converged=False), SETTINGS.fit.steps)

        return follow(fitter, refine, begun, self.deadline)

    def fitter(self, mismatch: Array) -> Fitter:
        """A fitter that counts costs in the scale of this mismatch."""
        least = SETTINGS.fit.least_scale * self.predictor.dry
        return Fitter(self.predictor, Weighing(scale_of(mismatch, self.predictor.counts, least), self.rows))

    def error(self, mismatch: Array) -> float:
        """Mean square of the mismatch over the rows that count."""
        return float(np.mean(mismatch[self.predictor.counts] ** 2))

    def fit_base(self) -> Selection:
        """The selection to begin with: the model's own parameters, fitted, and no term."""
        base = self.settle(self.start, None, self.predictor.mismatch(self.start.model(self.start.start)))
        return Selection(base, base, self.error(base.mismatch), noise_floor(self.predictor, base.mismatch))

    def settle(
        self, hypothesis: Hypothesis, coordinates: Array | None, mismatch: Array, jacobian: Array | None = None
    ) -> Fit:
        """Fit in the scale of the present mismatch, then in the scale of what is left; its Jacobian is fresh.

        `jacobian` is one to begin with, where one is known.
        """
        begun = self.fitter(mismatch).begin(hypothesis, coordinates, jacobian)
        if begun is None:
            raise ValueError("a hypothesis that makes no sense at its start")
        first = self._refined(begun, mismatch, begun.jacobian.shape[1])
        second = self._refined(first, first.mismatch, len(first.coordinates))
        return second if second.converged else self.refresh(second)

    def settle_candidate(self, candidate: Candidate, mismatch: Array) -> Fit:
        """A candidate's fit settled; its Jacobian serves when it has all rows."""
        fit = candidate.fit
        known = fit.jacobian if len(fit.jacobian) == len(mismatch) else None
        return self.settle(fit.hypothesis, fit.coordinates, mismatch, known)

    def settle_without(self, fit: Fit, index: int) -> Fit:
        """The fit without one of its terms."""
        gone = fit.hypothesis.share(index)
        kept = np.delete(fit.coordinates, gone)
        return self.settle(fit.hypothesis.without(index), kept, fit.mismatch, np.delete(fit.jacobian, gone, axis=1))

    def refresh(self, fit: Fit) -> Fit:
        """The fit with cost and Jacobian in the scale of its own mismatch."""
        fitter = self.fitter(fit.mismatch)
        cost = fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch)
        return replace(fit, cost=cost, jacobian=fitter.derivatives(fit))

    def _refined(self, fit: Fit, mismatch: Array, known: int) -> Fit:
        """The fit refined in the scale of a mismatch, with the first columns of its Jacobian to begin with."""
        fitter = self.fitter(mismatch)
        cost = fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch)
        return fitter.refine(replace(fit, cost=cost, converged=False), SETTINGS.fit.steps, known=known)

    def fit_to_end(self, fit: Fit) -> Fit:
        """A fit fitted on until it is at its end, or has had its turns."""
        for _ in range(SETTINGS.forward.refits):
            if fit.converged:
                break
            fit = self._refined(fit, fit.mismatch, len(fit.coordinates))
        return fit

    def fit_on(self, selection: Selection, present: Fit, fit: Fit, deserves: Deserves) -> tuple[Fit, Merit]:
        """A fit that deserves to come in, fitted on until it is at its end or nearly; and what it is worth."""
        merit = self.merit(selection, present, fit)
        for _ in range(SETTINGS.forward.refits):
            if fit.converged or not deserves(merit, fit):
                break
            further = self._refined(fit, fit.mismatch, len(fit.coordinates))
            later = self.merit(selection, present, further)
            near = later.of_left - merit.of_left < SETTINGS.forward.near * later.of_left
            fit, merit = replace(further, converged=further.converged or near), later
        return fit, merit

    def candidates(
        self, present: Fit, fine: bool = False, skip: frozenset[str] = frozenset()
    ) -> tuple[list[Candidate], int]:
        """All effects but `skip` tried beside the present fit, best first, and the number of starts.

        `fine`: finer forms among them.
        """
        whole = self.fitter(present.mismatch)
        quick = shorten(self.predictor, self.nominal, present.mismatch)
        short = Fitter(quick, Weighing(whole.weighing.scale, quick.counts.astype(np.float64)))
        fitted = present.hypothesis.written(present.coordinates)
        scene = SearchContext(self.start.document, self.predictor, present.mismatch, fine, fitted)
        trials = CandidateFits(whole, short, present, scene, not present.hypothesis.terms, self.deadline)
        found = trials.run(skip=once_only(present.hypothesis) | skip | self.untried)
        if scene.servo:  # what every geared servo has comes first: others swallow it, and their own parts after it
            found.sort(key=lambda candidate: SERVO.index(candidate.effect) if candidate.effect in SERVO else len(SERVO))
        self.on_progress(f"{trials.tried} starts tried; best: " + ", ".join(c.effect for c in found[:3]))
        return found, trials.tried

    def lower_floor(self, selection: Selection, mismatch: Array) -> Selection:
        """Take a mismatch into account that shows a lower floor than those before."""
        floor = min(selection.floor, noise_floor(self.predictor, mismatch), self.error(mismatch))
        return replace(selection, floor=floor)

    def nothing_left(self, selection: Selection) -> bool:
        """Whether no effect worth naming can hide in what the selection leaves."""
        mismatch = selection.fit.mismatch
        above = math.sqrt(max(self.error(mismatch) - selection.floor, 0.0)) / self.predictor.dry
        stretches = np.abs(stretch_means(self.predictor, mismatch) / self.predictor.dry)
        quiet = float(np.quantile(stretches, 1.0 - SETTINGS.forward.but_share)) < SETTINGS.forward.nothing_stretch
        return above < SETTINGS.forward.nothing_rms and quiet

    def merit(self, selection: Selection, without: Fit, with_term: Fit) -> Merit:
        """What the step from one fit to the other is worth, by floor and base of the selection."""
        explainable = above_noise(selection.base_error, selection.floor)
        saved = self.error(without.mismatch) - self.error(with_term.mismatch)
        torque = self._acting(without.mismatch, with_term.mismatch)
        fitter = self.fitter(with_term.mismatch)
        cost = fitter.cost(without.hypothesis, without.coordinates, without.mismatch)
        gain = 2.0 * (cost - with_term.cost) / self._correlation(with_term.mismatch, fitter.weighing.scale)
        blow = SETTINGS.worth.blow * float(np.median(np.abs(with_term.mismatch[self.predictor.counts]))) / 0.6745
        was, now = (self.error(np.clip(fit.mismatch, -blow, blow)) for fit in (without, with_term))
        of_left = (was - now) / above_noise(was, selection.floor)
        return Merit(saved / explainable, of_left, torque, gain, self._own_torque(without, with_term))

    def _acting(self, one: Array, other: Array) -> float:
        """Where two mismatches differ, by how much, as a share of dry friction."""
        return acting_torque(np.abs(one - other)[self.predictor.counts]) / self.predictor.dry

    def _own_torque(self, without: Fit, with_term: Fit) -> float:
        """The torque of the term that one fit has more than the other, all else as fitted with it; 0 for a level."""
        hypothesis = with_term.hypothesis
        pairs = zip(hypothesis.terms, (*without.hypothesis.terms, None), strict=False)
        term_index = next(index for index, (term, other) in enumerate(pairs) if term is not other)
        if not hypothesis.terms[term_index].unknowns:
            return 0.0
        kept = np.delete(with_term.coordinates, hypothesis.share(term_index))
        bare = self.fitter(with_term.mismatch).mismatch(hypothesis.without(term_index), kept)
        return 0.0 if bare is None else self._acting(bare, with_term.mismatch)

    def _correlation(self, mismatch: Array, scale: float) -> float:
        """By how much correlated rows exaggerate a gain: long-run over plain variance, at least 1."""
        period = self.predictor.traces[0].period_s
        clipped = np.clip(mismatch / scale, -4.0, 4.0)
        plain = float(clipped @ clipped)
        slow = float(long_run(clipped[:, None], max(1, round(SETTINGS.worth.gain_memory_s / period)))[0, 0])
        return max(slow / max(plain, 1e-30), 1.0)

    def may_enter(self, selection: Selection, merit: Merit, fit: Fit, index: int = -1) -> bool:
        """Whether a term (the last one, or the one at `index`) may come in: it deserves it, and its fit is sound."""
        return self.deserves(selection, merit, fit, index) and is_sound(merit, fit, index)

    def deserves(self, selection: Selection, merit: Merit, fit: Fit, index: int = -1) -> bool:
        """Whether a term (the last one, or the one at `index`) is significant and worth naming."""
        worth = worth_naming(merit, is_level_change(fit.hypothesis.terms[index]))
        return worth and self.significant(selection, merit, fit, index)

    def significant(self, selection: Selection, merit: Merit, fit: Fit, index: int = -1) -> bool:
        """Bayesian information criterion with a correction for the number of starts tried."""
        unknowns = max(len(fit.hypothesis.terms[index].unknowns), 1)
        rows = float(self.rows.sum())
        return merit.gain > unknowns * math.log(rows) + 2.0 * math.log(max(selection.tried, 1)) + 20.0


def is_sound(merit: Merit, fit: Fit, index: int = -1) -> bool:
    """Whether the fit of a term has come to an end, and says that the term is what it is called."""
    return (fit.converged or merit.share >= SETTINGS.worth.sure_share) and not is_another(fit, index)


def once_only(hypothesis: Hypothesis) -> set[str]:
    """Effects that are in already and cannot come in again."""
    return {term.effect for term in hypothesis.terms if not effect(term.effect).repeatable}
