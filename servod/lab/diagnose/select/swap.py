"""Puts rivals in the place of terms that came in before others: what was best alone need not be best in company.

Stands behind the selection and before the proof.
"""

from __future__ import annotations

import math
from dataclasses import replace
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.choice import Choice, Entry
from servod.lab.diagnose.select.choose import Chooser
from servod.lab.diagnose.select.fit import Fit

Array = NDArray[np.float64]

#: Rivals of a term that are tried: so many at most, which left at most so many times what the term left.
TRIED, WITHIN = 2, 2.5

#: A rival takes the place when the cost falls by more than this share of it, or with fewer unknowns rises by less.
BETTER = 0.01


def swapped(chooser: Chooser, choice: Choice) -> None:
    """Try rivals in the place of every term but the last, which had them all beside it."""
    before = choice.fit
    for index in range(len(choice.fit.hypothesis.terms) - 1):
        for rival in _rivals(choice, index):
            if monotonic() > chooser.deadline or _swap(chooser, choice, index, rival):
                break
    if choice.fit is not before:
        _judge_anew(chooser, choice)


def _swap(chooser: Chooser, choice: Choice, index: int, rival: Candidate) -> bool:
    """Put a rival in the place of a term if it does better there and deserves to come in; whether it did."""
    other = _instead(chooser, choice.fit, index, rival)
    if other is None or not _better(chooser, choice.fit, other):
        return False
    merit = chooser.merit(chooser.less(other, index), other)
    if not chooser.enters(merit, other, index):
        return False
    entry = choice.entries[index]
    old = Candidate(choice.fit.hypothesis.terms[index].effect, choice.fit, entry.left, index)
    rest = [c for c in entry.rivals if c.effect != rival.effect]
    choice.entries[index] = Entry(entry.left, [old, *rest])
    choice.merits[index] = merit
    choice.fit = other
    return True


def _judge_anew(chooser: Chooser, choice: Choice) -> None:
    """Drop terms whose work a term that was put in now does, and say what each of the others is worth beside it."""
    chooser.prune(choice)
    last = len(choice.fit.hypothesis.terms) - 1
    choice.merits[last] = chooser.merit(chooser.less(choice.fit, last), choice.fit)


def _rivals(choice: Choice, index: int) -> list[Candidate]:
    """Rivals of a term that stood close when it came in and are not in by now."""
    entry, there = choice.entries[index], {term.effect for term in choice.fit.hypothesis.terms}
    return [c for c in entry.rivals if c.left <= WITHIN * entry.left and c.effect not in there][:TRIED]


def _instead(chooser: Chooser, fit: Fit, index: int, rival: Candidate) -> Fit | None:
    """The fit with a rival's term in the place of its own, started where the rival's fit ended."""
    terms = list(fit.hypothesis.terms)
    terms[index] = rival.term
    hypothesis = replace(fit.hypothesis, terms=tuple(terms))
    at = _coordinates(fit, hypothesis, index, rival)
    try:
        return chooser.settled(hypothesis, at, fit.mismatch)
    except ValueError:
        return None


def _coordinates(fit: Fit, hypothesis: Hypothesis, index: int, rival: Candidate) -> Array:
    """Coordinates of the fit, with the rival's own, and with its values of what either of the two opens."""
    own = fit.hypothesis.share(index)
    at = np.concatenate([fit.coordinates[: own.start], rival.own, fit.coordinates[own.stop :]])
    opened = set(fit.hypothesis.terms[index].opens) | set(hypothesis.terms[index].opens)
    for place, unknown in enumerate(hypothesis.base):
        if unknown.key in opened:
            at[place] = rival.fit.coordinates[place]
    return np.asarray(at)


def _better(chooser: Chooser, old: Fit, new: Fit) -> bool:
    """Whether the new fit costs less, in the scale of the old one."""
    fitter = chooser.fitter(old.mismatch)
    was, now = (fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch) for fit in (old, new))
    fewer = _size(new) < _size(old)
    return math.log(max(now, 1e-30) / max(was, 1e-30)) < (BETTER if fewer else -BETTER)


def _size(fit: Fit) -> int:
    return sum(term.numbers for term in fit.hypothesis.terms)
