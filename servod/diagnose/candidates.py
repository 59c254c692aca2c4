"""Tries every effect on what the present fit leaves: a step or two for all starts, full fits for the best.

Stands between the effects' files and the selection. Candidates reuse the Jacobian of the present fit for what they have
in common with it, so that a start costs a few simulations only.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from time import monotonic

from servod.diagnose.effects import effects
from servod.diagnose.fit import Fit, Fitter
from servod.diagnose.hypothesis import Term
from servod.diagnose.scene import Scene

#: Starts that go on to the second step, effects that are fitted to the end, and steps of such a fit.
SECOND_ROUND, FULL_FITS, FULL_STEPS = 16, 6, 8

#: A candidate is fitted to the end when it has saved at least 1 - IN_REACH of what the best has saved.
IN_REACH = 0.4


@dataclass(frozen=True)
class Candidate:
    """An effect on trial: its fit and how many forms and starts stood in competition."""

    effect: str
    fit: Fit


class Trials:
    """Fits candidates against one present fit."""

    def __init__(self, fitter: Fitter, present: Fit, scene: Scene, nominal: Fit | None, deadline: float) -> None:
        self.fitter, self.present, self.scene, self.nominal, self.deadline = fitter, present, scene, nominal, deadline
        self.tried = 0

    def run(self, skip: Iterable[str] = ()) -> list[Candidate]:
        """Candidates fitted to the end, best first; effects in `skip` are not tried."""
        first = [c for effect in effects() if effect.name not in skip for c in self._starts(effect.name)]
        first.sort(key=lambda c: c.fit.cost)
        kept = len(self.present.coordinates)
        second = [self._refined(c, 2, kept) for c in best_of_each(first, SECOND_ROUND, 2)]
        second.sort(key=lambda c: c.fit.cost)
        chosen = best_of_each(second, FULL_FITS, 1)
        close = self.within_reach(chosen)
        fitted = sorted((self._refined(c, FULL_STEPS, 0) for c in close), key=lambda c: c.fit.cost)
        return fitted + [c for c in chosen if c.effect not in {f.effect for f in fitted}]

    def within_reach(self, candidates: list[Candidate]) -> list[Candidate]:
        """Those of the sorted candidates that a fit to the end may still bring to the top."""
        best = candidates[0].fit.cost if candidates else 0.0
        limit = best + IN_REACH * max(self.present.cost - best, 0.0)
        return [c for c in candidates if c.fit.cost <= limit][:FULL_FITS]

    def _starts(self, name: str) -> list[Candidate]:
        """All starts of an effect after one step each."""
        from servod.diagnose.effects import effect

        found = []
        for term in effect(name).terms(self.scene):
            for begun in self._begun(term, effect(name).far):
                self.tried += 1
                found.append(Candidate(name, self.fitter.refine(begun, 1, begun.jacobian.shape[1], 2)))
        return found

    def _begun(self, term: Term, far: bool) -> list[Fit]:
        """The term beside the present fit, and for far effects beside the nominal model."""
        froms = [self.present, self.nominal] if far and self.nominal is not None else [self.present]
        begun = []
        for beside in froms:
            hypothesis = beside.hypothesis.with_term(term)
            fit = self.fitter.begin(hypothesis, hypothesis.beside(beside.coordinates), beside.jacobian)
            begun += [fit] if fit is not None else []
        return begun

    def _refined(self, candidate: Candidate, steps: int, keep: int) -> Candidate:
        if monotonic() > self.deadline:
            return candidate
        return Candidate(candidate.effect, self.fitter.refine(candidate.fit, steps, keep))


def best_of_each(sorted_candidates: list[Candidate], count: int, each: int) -> list[Candidate]:
    """The first `count` candidates with at most `each` of the same effect."""
    kept: list[Candidate] = []
    for candidate in sorted_candidates:
        if sum(other.effect == candidate.effect for other in kept) < each:
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept
