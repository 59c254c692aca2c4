"""Counts scored cases: shares with their intervals, the confusion matrix, errors, coverage, calibration, times.

Between scoring and the report; plain numbers, nothing drawn.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from servod.qualify.blind.plan import Sort
from servod.qualify.blind.score import Guess, Parameter, Scored

Document = dict[str, Any]

#: Bins of stated confidence.
CONFIDENCES = (0.0, 0.5, 0.7, 0.85, 0.95, 1.0)

#: A hold-out says something of a missing effect when the believed model is off by this many times the true one.
TELLING = 3.0

#: A diagnosis that took this share of its time limit may have ended its search early: the machine was too busy.
HURRIED = 0.7

#: What a trial has to reach: least shares of right answers, plain and harder; then most and least of the other figures.
GOALS = {Sort.SINGLE: 0.85, Sort.PAIR: 0.70, Sort.NOTHING: 0.95, Sort.UNKNOWN: 0.90}
HARDER_GOALS = {Sort.SINGLE: 0.70, Sort.NOTHING: 0.90}
MOST_ERROR, LEAST_COVERED, MOST_HELD_OUT, MOST_OVER_TRUE = 0.10, 0.90, 0.15, 2.0


def share(right: int, of: int) -> Document:
    """A share with its 95 % interval (Wilson, JASA 22, 1927)."""
    if of == 0:
        return {"cases": 0, "right": 0, "share": None, "interval": [0.0, 1.0]}
    z, p = 1.96, right / of
    middle = (p + z * z / (2 * of)) / (1 + z * z / of)
    half = z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of)) / (1 + z * z / of)
    interval = [round(max(middle - half, 0.0), 3), round(min(middle + half, 1.0), 3)]
    return {"cases": of, "right": right, "share": round(p, 4), "interval": interval}


def shares(cases: Iterable[Scored], key: Callable[[Scored], str | None]) -> dict[str, Document]:
    """Shares of right answers by a property of the case; None leaves a case out."""
    counts: dict[str, list[bool]] = {}
    for case in cases:
        name = key(case)
        if name is not None:
            counts.setdefault(name, []).append(case.right)
    return {name: share(sum(right), len(right)) for name, right in sorted(counts.items())}


def by_effect(cases: Sequence[Scored]) -> dict[str, Document]:
    """For each concealed effect, alone or in a pair: how often it was named."""
    counts: dict[str, list[bool]] = {}
    for case in cases:
        named = rows_named(case)
        for effect in case.truth["effects"]:
            counts.setdefault(effect, []).append(effect in named)
    return {name: share(sum(found), len(found)) for name, found in sorted(counts.items())}


def rows_named(case: Scored) -> set[str]:
    """Names in an answer, with the twin of a name where the twin is right."""
    wrong = {guess.effect for guess in case.guesses if not guess.right}
    right = {guess.effect for guess in case.guesses if guess.right}
    twins = set(case.truth["effects"]) if right and not right <= set(case.truth["effects"]) else set()
    return wrong | right | twins


def confusion(cases: Sequence[Scored]) -> dict[str, dict[str, int]]:
    """Truth -> answer -> count. Of a pair each effect is a row; its partner's name is no confusion."""
    found: dict[str, Counter[str]] = {}
    for case in cases:
        effects = case.truth["effects"]
        named = rows_named(case)
        extra = sorted(named - set(effects))
        for effect in effects or [case.sort.value]:
            row = found.setdefault(effect, Counter())
            answers = [effect] if effect in named else extra or [case.verdict]
            row.update(answers + (extra if effect in named else []))
    return {effect: dict(row) for effect, row in sorted(found.items())}


def parameters(cases: Sequence[Scored]) -> Document:
    """Errors (shares) and coverage of all true parameters of what was found, told or not, and by effect."""
    true = [parameter for case in cases for parameter in case.parameters]
    effects = sorted({parameter.effect for parameter in true})
    rows = {effect: [p for p in true if p.effect == effect] for effect in effects}
    return {"all": _errors(true), "by_effect": {effect: _errors(row) for effect, row in rows.items()}}


def _errors(true: Sequence[Parameter]) -> Document:
    if not true:
        return {"parameters": 0, "missing": 0, "median_error": None, "covered": None}
    error = float(np.median([parameter.error for parameter in true]))
    covered = float(np.mean([parameter.covered for parameter in true]))
    missing = sum(not parameter.reported for parameter in true)
    counted = {"parameters": len(true), "missing": missing}
    return counted | {"median_error": round(error, 5), "covered": round(covered, 4)}


def calibration(cases: Sequence[Scored]) -> list[Document]:
    """For each bin of stated confidence: how many findings, what they state on average, and how many are right."""
    guesses: list[Guess] = [guess for case in cases for guess in case.guesses]
    found = []
    for low, high in pairwise(CONFIDENCES):
        inside = [g for g in guesses if low <= g.confidence < high or g.confidence == high == 1.0]
        stated = float(np.mean([g.confidence for g in inside])) if inside else None
        found.append({"low": low, "high": high, "stated": stated, **share(sum(g.right for g in inside), len(inside))})
    return found


def held_out(cases: Sequence[Scored]) -> Document:
    """Windowed hold-out errors: after over before where an effect was concealed, after over the true model's own.

    After over before is counted of all such cases, and of those where the believed model is off by TELLING times the
    true one or there is no true one: where both are alike the ratio says nothing of what was found.
    """
    hidden = [c.held_out for c in cases if c.sort in (Sort.SINGLE, Sort.PAIR)]
    telling = [h for h in hidden if not h.before < TELLING * h.own]
    known = [c.held_out for c in cases if not math.isnan(c.held_out.own)]
    return {
        "after_over_before": _spread([h.after / h.before for h in telling]),
        "after_over_before_all": _spread([h.after / h.before for h in hidden]),
        "after_over_true": _spread([h.after / h.own for h in known]),
    }


def times(cases: Sequence[Scored]) -> Document:
    """Wall clock, processor time and memory of the diagnoses."""
    runs = [case.run for case in cases if case.run]
    spent = {key: _spread([run[key] for run in runs]) for key in ("wall_s", "cpu_s", "memory_mib")}
    return spent | {"hurried": sum(run["wall_s"] >= HURRIED * run["time_limit_s"] for run in runs)}


def _spread(values: Sequence[float]) -> Document:
    if not values:
        return {"count": 0, "median": None, "p90": None, "max": None}
    middle, high = (round(float(np.quantile(values, q)), 5) for q in (0.5, 0.9))
    return {"count": len(values), "median": middle, "p90": high, "max": round(float(max(values)), 5)}
