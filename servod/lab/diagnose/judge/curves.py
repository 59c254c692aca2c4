"""Curves that the page of a diagnosis draws: signatures of terms, errors over time and over frequency.

Stands beside `conclude`, which puts them into the result; what draws them computes nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.judge.judgement import JudgedSelection
from servod.lab.diagnose.predict.coordinates import coordinates
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import Signature, SignaturePart, Spectrum
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

_HALVES = {Split.DIRECTION: ("forward", "back"), Split.LOAD: ("command above zero", "command below zero")}


def signature(judgement: JudgedSelection, term_index: int) -> Signature:
    """What is left without the term at `term_index`, and what it makes of it, over its coordinate and over time."""
    predictor, shown = judgement.predictor, effect(judgement.fit.hypothesis.terms[term_index].effect).look
    without, left = judgement.validation.reduced[term_index].mismatch, judgement.fit.mismatch
    term = without - left
    known = coordinates(predictor)
    unit, values = known.get(shown.coordinate, known["position"])
    period = _period(judgement, term_index, values) if shown.periodic else None
    if period is not None:
        values = values % period
    parts = tuple(
        _part(name, values, without, term, rows & predictor.counts & np.isfinite(values))
        for name, rows in _halves(predictor, shown).items()
    )
    index, first, rows = _stretch(predictor, term)
    trace, begun = predictor.traces[index], predictor.slices[index].start + first
    here, t_s = slice(begun, begun + rows), trace.drive.t_s[first : first + rows] - trace.shift_s
    return Signature(
        term_index + 1, shown.coordinate, unit, period, parts, trace.name, t_s, without[here], term[here], left[here]
    )


def _halves(predictor: Predictor, shown: Look) -> dict[str, NDArray[np.bool_]]:
    """Rows that are drawn by themselves: all, or by the sign of velocity or command."""
    if shown.split is Split.NONE:
        return {"": np.ones(len(predictor.counts), dtype=bool)}
    over = predictor.over("velocity" if shown.split is Split.DIRECTION else "torque")
    first, second = _HALVES[shown.split]
    return {first: over > 0.0, second: over < 0.0}


def _part(name: str, values: Array, without: Array, term: Array, rows: NDArray[np.bool_]) -> SignaturePart:
    """Means over bins with as many rows each."""
    if int(rows.sum()) < 2 * SETTINGS.maps.least_in_bin:
        return SignaturePart(name, *(np.zeros(0) for _ in range(4)))
    edges = np.unique(np.quantile(values[rows], np.linspace(0.0, 1.0, SETTINGS.curves.signature_bins + 1)))
    bin_index = np.clip(np.searchsorted(edges, values[rows], side="right") - 1, 0, max(len(edges) - 2, 0))
    count = np.bincount(bin_index)
    full = count >= min(SETTINGS.maps.least_in_bin, count.max())
    middle, left, made = (
        (np.bincount(bin_index, part[rows]) / np.maximum(count, 1))[full] for part in (values, without, term)
    )
    square = (np.bincount(bin_index, without[rows] ** 2) / np.maximum(count, 1))[full]
    independent = np.maximum(count[full] / SETTINGS.curves.correlated_rows, 1.0)
    return SignaturePart(name, middle, left, 2.0 * np.sqrt(np.maximum(square - left**2, 0.0) / independent), made)


def _period(judgement: JudgedSelection, index: int, values: Array) -> float | None:
    """The period of a periodic term where many of them lie in the range."""
    fit = judgement.fit
    reported = fit.hypothesis.terms[index].report(
        fit.hypothesis.written(fit.coordinates), fit.values[fit.hypothesis.share(index)]
    )
    found = {one.name: one.value for one in reported}
    if "periods_per_turn" in found:
        period = 2.0 * math.pi / found["periods_per_turn"]
    elif "periods_per_metre" in found:
        period = 1.0 / found["periods_per_metre"]
    else:
        return None
    return period if float(np.ptp(values)) > SETTINGS.curves.fold_from * period else None


def _stretch(predictor: Predictor, term: Array) -> tuple[int, int, int]:
    """The stretch in which a term takes most: recording, first row in it, rows."""
    best: tuple[float, int, int, int] = (-1.0, 0, 0, 1)
    for index, (trace, part) in enumerate(zip(predictor.traces, predictor.slices, strict=True)):
        rows = min(max(2, round(SETTINGS.curves.stretch_s / trace.period_s)), part.stop - part.start)
        power = np.concatenate([[0.0], np.cumsum(term[part] ** 2)])
        taken = power[rows:] - power[:-rows]
        first = int(np.argmax(taken))
        best = max(best, (float(taken[first]) / rows, index, first, rows))
    return best[1:]


def course(trace: CheckedTrace, *errors: Array) -> tuple[Array, ...]:
    """Begins of short stretches of a recording, s, and the root mean square of each error in them."""
    rows = max(1, round(SETTINGS.curves.course_s / trace.period_s))
    count = len(trace.drive.t_s) // rows
    t_s = trace.drive.t_s - trace.shift_s
    means = ((error[: count * rows].reshape(count, rows) ** 2).mean(axis=1) for error in errors)
    return (t_s[: count * rows : rows], *(np.sqrt(mean) for mean in means))


def spectrum(predictor: Predictor, error: Array) -> Spectrum:
    """Amplitude density over frequency, averaged over the recordings on common bands."""
    from scipy.signal import welch

    bands = SETTINGS.curves.bands
    edges = np.geomspace(SETTINGS.curves.lowest_hz, SETTINGS.curves.highest_hz, bands + 1)
    power, rows = np.zeros(bands), np.zeros(bands)
    for trace, part in zip(predictor.traces, predictor.slices, strict=True):
        length = min(len(error[part]), round(SETTINGS.curves.window_s / trace.period_s))
        frequency, density = welch(error[part], 1.0 / trace.period_s, nperseg=length)
        band_index = np.digitize(frequency, edges) - 1
        inside = (band_index >= 0) & (band_index < bands)
        power += np.bincount(band_index[inside], density[inside], bands)
        rows += np.bincount(band_index[inside], minlength=bands)
    full = rows > 0
    middles = np.sqrt(edges[:-1] * edges[1:])[full]
    return Spectrum(middles, np.sqrt(np.maximum(power[full] / rows[full], 1e-300)))
