"""The engine's last stage: findings with their numbers, errors and curves, and the model, from what was judged.

Behind the verdict. What it returns is finished: whoever shows it computes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects.disturbance import EVERY, NAME
from servod.lab.diagnose.effects.hypothesis import Document, Reported
from servod.lab.diagnose.judge.covariance import inside_region
from servod.lab.diagnose.judge.curves import course, signature, spectrum
from servod.lab.diagnose.judge.free_run import window_errors, windows
from servod.lab.diagnose.judge.judgement import JudgedSelection
from servod.lab.diagnose.judge.locate import bands, locate
from servod.lab.diagnose.judge.verdict import alternatives, confidence
from servod.lab.diagnose.predict.floor import trace_floor
from servod.lab.diagnose.result import (
    Evidence,
    FittedValue,
    Minor,
    NamedEffect,
    Quality,
    RecordingErrors,
    SearchEffort,
    Windows,
)
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit
from servod.lab.diagnose.select.selection import Fold
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


def conclude(judgement: JudgedSelection, model: AxisModel, free: tuple[Windows, ...]) -> Evidence:
    """The plain result; `model` is that of `extended_model` and `free` the errors of `free_windows`."""
    predictor, selection = judgement.predictor, judgement.selection
    return Evidence(
        findings=findings(judgement),
        recalibrated=recalibrated(judgement),
        minor=minor(judgement),
        residual=judgement.residual,
        model=model,
        quality=_quality(judgement, free),
        maps_before=tuple(judgement.maps_before),
        maps_after=tuple(judgement.maps_after),
        bands=bands(predictor, selection.base.mismatch),
        recordings=tuple(_recording(judgement, index) for index in range(len(predictor.traces))),
        search=SearchEffort(predictor.rate, selection.tried, selection.cut),
        encoder_noise=predictor.encoder_noise,
        dry_friction=predictor.dry,
    )


def findings(judgement: JudgedSelection) -> tuple[NamedEffect, ...]:
    """One for each effect; terms of the same effect are one finding."""
    terms = judgement.fit.hypothesis.terms
    names = list(dict.fromkeys(terms[place].effect for place in judgement.named))
    return tuple(_finding(judgement, name, [p for p in judgement.named if terms[p].effect == name]) for name in names)


def _finding(judgement: JudgedSelection, name: str, named: Sequence[int]) -> NamedEffect:
    fit, first, selection = judgement.fit, named[0], judgement.selection
    contribution = judgement.validation.reduced[first].mismatch - fit.mismatch
    return NamedEffect(
        effect=name,
        forms=tuple(fit.hypothesis.terms[place].form for place in named),
        parameters=parameters(judgement, named),
        confidence=min(confidence(selection, place, judgement.errors.removed) for place in named),
        alternatives=tuple(alternatives(selection, first)),
        located=locate(judgement.predictor, contribution, judgement.predictor.dry),
        removed_share=judgement.removed_share(first),
        torque=selection.merits[first].torque,
        without=judgement.validation.without[first].rms,
        after=judgement.validation.after.rms,
        signatures=tuple(signature(judgement, place) for place in named),
    )


def parameters(judgement: JudgedSelection, named: Sequence[int]) -> dict[str, FittedValue]:
    """Reported values of the terms with their 95 % intervals; later terms of the same effect are numbered."""
    found: dict[str, FittedValue] = {}
    for count, place in enumerate(named):
        values = _reported(judgement.fit, place, judgement.fit.coordinates)
        deviations = _deviations(judgement, place, values)
        for one, deviation in zip(values, deviations, strict=True):
            name = one.name if count == 0 else f"{one.name}_term{count + 1}"
            half = SETTINGS.intervals.z95 * deviation
            found[name] = FittedValue(one.value, one.unit, one.value - half, one.value + half)
    return found


def _reported(fit: Fit, place: int, coordinates: Array) -> list[Reported]:
    document = fit.hypothesis.written(coordinates)
    return fit.hypothesis.terms[place].tell(document, fit.hypothesis.values(coordinates)[fit.hypothesis.share(place)])


def _deviations(judgement: JudgedSelection, place: int, values: Sequence[Reported]) -> Array:
    """Standard deviations of reported values, by their derivatives."""
    fit = judgement.fit
    slopes = np.zeros((len(values), len(fit.coordinates)))
    for index in range(len(fit.coordinates)):
        nudged = fit.coordinates.copy()
        nudged[index] += 1e-5
        there = _reported(fit, place, nudged)
        slopes[:, index] = [(b.value - a.value) / 1e-5 for a, b in zip(values, there, strict=True)]
    variances = np.einsum("ij,jk,ik->i", slopes, judgement.covariance, slopes)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def minor(judgement: JudgedSelection) -> dict[str, Minor]:
    """Effects that are there but not worth naming, and those that stand in the model and are no findings."""
    terms, merits = judgement.fit.hypothesis.terms, judgement.selection.merits
    named = {terms[place].effect for place in judgement.named}
    seen = {name: _minor(merit) for name, merit in judgement.selection.minor.items() if name not in named}
    for name in dict.fromkeys(terms[place].effect for place in judgement.kept):
        those = [place for place in judgement.kept if terms[place].effect == name]
        largest = _minor(max((merits[place] for place in those), key=lambda merit: merit.torque))
        seen[name] = Minor(largest.torque, largest.share, judgement.kept[those[0]], parameters(judgement, those))
    return seen


def _minor(merit: Merit) -> Minor:
    return Minor(merit.torque, max(merit.share, 0.0))


def recalibrated(judgement: JudgedSelection) -> dict[str, FittedValue]:
    """Parameters of the model itself that were off, with their 95 % intervals. Those of a finding are not here."""
    fit = judgement.fit
    opened = {key for place in judgement.named for key in fit.hypothesis.terms[place].opens}
    found = {}
    for index, (unknown, nominal) in enumerate(zip(fit.hypothesis.unknowns, fit.hypothesis.base, strict=False)):
        value = fit.values[index]
        half = SETTINGS.intervals.z95 * math.sqrt(max(float(judgement.covariance[index, index]), 0.0))
        size = unknown.size if unknown.size else abs(value)
        if unknown.key in opened or abs(value - nominal.start) <= max(SETTINGS.intervals.least_change, half) * size:
            continue
        half *= size
        found[unknown.key] = FittedValue(value, unknown.unit, value - half, value + half, nominal.start)
    return found


def extended_model(judgement: JudgedSelection, nominal: AxisModel) -> AxisModel:
    """The axis model with the physics added.

    A disturbance that stood in one recording is an event, no physics of the axis, and stays out.
    """
    fit = judgement.fit
    document: Document = fit.hypothesis.written(_model_coordinates(judgement))
    document.pop(NAME, None)
    values = fit.values
    for place, term in enumerate(fit.hypothesis.terms):
        if term.effect == NAME and term.form == EVERY:
            start, length, torque = values[fit.hypothesis.share(place)]
            rows = document.setdefault(NAME, {}).setdefault("windows", [])
            rows.append({"start_s": start, "end_s": start + length, "torque": torque})
    left = judgement.residual
    if left is not None:
        table = {"grid": left.grid.tolist(), "torque": left.torque.tolist()}
        document.setdefault("residual", {})[left.coordinate] = table
    if nominal.noise is not None:
        document["noise"] = nominal.noise.model_dump(mode="json", exclude_none=True)
    return AxisModel.model_validate(document)


def _model_coordinates(judgement: JudgedSelection) -> Array:
    """Coordinates of the model to hand out: what the report says, as long as that can be said.

    Where nothing has a name, parameters that are not told from what they were stay what they were: those of an axis
    that was identified are worth more than what one short recording makes of them. That holds as long as all of them
    together lie in the region of 95 % around the fit; beyond it, the fit.
    """
    fit = judgement.fit
    if fit.hypothesis.terms or judgement.residual is not None:
        return fit.coordinates
    changed = recalibrated(judgement)
    moved = [unknown.key in changed for unknown in fit.hypothesis.base]
    back = np.where(moved, 0.0, fit.coordinates - fit.hypothesis.start)
    return fit.coordinates - back if inside_region(back, judgement.covariance) else fit.coordinates


def free_windows(judgement: JudgedSelection, nominal: AxisModel, model: AxisModel) -> tuple[Windows, ...]:
    """Errors of free windows. What has no name is a table over everything, so that its rows have been seen."""
    predictor, after = judgement.predictor, judgement.validation.after.folds
    if judgement.residual is not None:
        after = (Fold(np.ones(len(predictor.counts), dtype=bool), (model,)),)
    errors = window_errors(predictor, nominal, judgement.validation.before.folds, after)
    return windows(errors, predictor, judgement.validation.folds.judged)


def _quality(judgement: JudgedSelection, free: tuple[Windows, ...]) -> Quality:
    """Errors before and after, and for how long the recordings are not judged since only an event stands there."""
    predictor, shared = judgement.predictor, judgement.validation.folds
    events = predictor.counts & ~shared.judged
    seconds = sum(
        trace.period_s * int(events[part].sum())
        for trace, part in zip(predictor.traces, predictor.slices, strict=True)
    )  # fmt: skip
    return Quality(
        before=judgement.validation.before.rms,
        after=judgement.validation.after.rms,
        noise_floor=judgement.unseen.floor,
        removed=judgement.unseen.removed,
        removed_by_known=judgement.removed_by_known,
        left_out=shared.left_out,
        not_judged_s=seconds,
        windows=free,
        spectrum_before=spectrum(predictor, judgement.validation.before.mismatch),
        spectrum_after=spectrum(predictor, judgement.validation.after.mismatch),
    )


def _recording(judgement: JudgedSelection, index: int) -> RecordingErrors:
    """One recording by fits that have not seen the rows."""
    predictor = judgement.predictor
    trace, part = predictor.traces[index], predictor.slices[index]
    before, after = judgement.validation.before.mismatch[part], judgement.validation.after.mismatch[part]
    judged, curves = judgement.validation.folds.judged[part], course(trace, before, after)
    floor = math.sqrt(trace_floor(predictor, index, judgement.fit.mismatch))
    return RecordingErrors(
        trace.name, trace.duration_s, int(predictor.counts[part].sum()), trace.period_s, trace.position_noise,
        trace.notes, floor, _rms(before[judged]), _rms(after[judged]), *curves,
    )  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
