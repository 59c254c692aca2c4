"""The engine's last stage: findings with their numbers, errors and curves, and the model, from what was judged.

Behind the verdict. What it returns is finished: whoever shows it computes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects import effect, effects
from servod.lab.diagnose.effects.disturbance import EVERY, NAME
from servod.lab.diagnose.effects.effect import MAP
from servod.lab.diagnose.effects.hypothesis import LEVEL, Document, Reported, Unknown, get
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.judge.covariance import bounded_error, inside_region
from servod.lab.diagnose.judge.curves import course, signature, spectrum
from servod.lab.diagnose.judge.free_run import window_errors, windows
from servod.lab.diagnose.judge.judgement import JudgedSelection, write_table
from servod.lab.diagnose.judge.locate import bands, locate
from servod.lab.diagnose.judge.verdict import alternatives, confidence, product_with
from servod.lab.diagnose.predict.floor import trace_floor
from servod.lab.diagnose.result import (
    Evidence,
    FittedValue,
    Minor,
    MinorReason,
    NamedEffect,
    PartialAnswer,
    Quality,
    RecordingErrors,
    SearchEffort,
    Windows,
)
from servod.lab.diagnose.select.fit import Fit, on_bound
from servod.lab.diagnose.select.levels import at_end_of_range, is_level_change, shorter_twin
from servod.lab.diagnose.select.merit import Merit, large_enough
from servod.lab.diagnose.select.selection import Selection
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.select.stepwise import DRIFT, power_of_means
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

#: Keys of the drive begin so.
DRIVE = "drive."


def conclude(
    judgement: JudgedSelection, model: AxisModel, free: tuple[Windows, ...], partial: PartialAnswer | None = None
) -> Evidence:
    """The plain result; `model` is that of `extended_model` and `free` the errors of `free_windows`."""
    predictor, selection = judgement.predictor, judgement.selection
    return Evidence(
        findings=findings(judgement),
        recalibrated=recalibrated(judgement),
        drive=fitted_drive(judgement),
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
        partial=partial,
    )


def findings(judgement: JudgedSelection) -> tuple[NamedEffect, ...]:
    """One for each effect; terms of the same effect are one finding."""
    terms = judgement.fit.hypothesis.terms
    names = list(dict.fromkeys(terms[index].effect for index in judgement.named))
    return tuple(_finding(judgement, name, [p for p in judgement.named if terms[p].effect == name]) for name in names)


def _finding(judgement: JudgedSelection, name: str, named: Sequence[int]) -> NamedEffect:
    fit, first, selection = judgement.fit, named[0], judgement.selection
    contribution = judgement.validation.reduced[first].mismatch - fit.mismatch
    product = product_with(judgement.predictor, fit.model, name)
    sure = min(confidence(selection, index, judgement.errors.removed) for index in named)
    others = alternatives(selection, first)
    return NamedEffect(
        effect=name,
        forms=tuple(fit.hypothesis.terms[index].form for index in named),
        parameters=parameters(judgement, named),
        confidence=min(sure, SETTINGS.verdict.either) if product else sure,
        alternatives=tuple(dict.fromkeys([product, *others] if product else others)),
        located=locate(judgement.predictor, contribution, judgement.predictor.dry),
        removed_share=judgement.removed_share(first),
        torque=selection.merits[first].torque,
        without=judgement.validation.without[first].rms,
        after=judgement.validation.after.rms,
        signatures=tuple(signature(judgement, index) for index in named),
        product_with=product,
    )


def parameters(judgement: JudgedSelection, named: Sequence[int]) -> dict[str, FittedValue]:
    """Reported values of the terms with their 95 % intervals; later terms of the same effect are numbered."""
    found: dict[str, FittedValue] = {}
    for count, index in enumerate(named):
        values = _reported(judgement.fit, index, judgement.fit.coordinates)
        deviations = _deviations(judgement, index, values)
        for one, deviation in zip(values, deviations, strict=True):
            name = one.name if count == 0 else f"{one.name}_term{count + 1}"
            half = SETTINGS.intervals.z95 * deviation
            found[name] = FittedValue(one.value, one.unit, one.value - half, one.value + half)
    return found


def _reported(fit: Fit, index: int, coordinates: Array) -> list[Reported]:
    document = fit.hypothesis.written(coordinates)
    return fit.hypothesis.terms[index].report(document, fit.hypothesis.values(coordinates)[fit.hypothesis.share(index)])


def _deviations(judgement: JudgedSelection, term_index: int, values: Sequence[Reported]) -> Array:
    """Standard deviations of reported values, by their derivatives."""
    fit = judgement.fit
    slopes = np.zeros((len(values), len(fit.coordinates)))
    inward = np.where(fit.coordinates + 1e-5 <= fit.hypothesis.bounds[1], 1e-5, -1e-5)
    for index, nudge in enumerate(inward):
        nudged = fit.coordinates.copy()
        nudged[index] += nudge
        there = _reported(fit, term_index, nudged)
        slopes[:, index] = [(b.value - a.value) / nudge for a, b in zip(values, there, strict=True)]
    covariance = judgement.covariance + bounded_error(fit)
    variances = np.einsum("ij,jk,ik->i", slopes, covariance, slopes)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def minor(judgement: JudgedSelection) -> dict[str, Minor]:
    """Effects that are there but not worth naming, and those that stand in the model and are no findings."""
    terms, merits = judgement.fit.hypothesis.terms, judgement.selection.merits
    named = {terms[index].effect for index in judgement.named}
    seen = {name: _minor(merit) for name, merit in judgement.selection.minor.items() if name not in named}
    for name, (merit, why) in judgement.selection.rejected.items():
        if name not in named:
            seen[name] = replace(_minor(merit), why=why)
    for name in dict.fromkeys(terms[index].effect for index in judgement.kept):
        those = [index for index in judgement.kept if terms[index].effect == name]
        largest = _minor(max((merits[index] for index in those), key=lambda merit: merit.torque))
        seen[name] = Minor(largest.torque, largest.share, judgement.kept[those[0]], parameters(judgement, those))
    return seen


def _minor(merit: Merit) -> Minor:
    return Minor(merit.torque, max(merit.share, 0.0))


def recalibrated(judgement: JudgedSelection) -> dict[str, FittedValue]:
    """Parameters of the model itself that were off, with their 95 % intervals.

    Those of a finding are not here, nor one that stands on its bound: what the data say of it nobody has asked them.
    A factor on the model's own that is under its level is in the value.
    """
    fit = judgement.fit
    reported = {
        *judgement.named,
        *(term_index for term_index in judgement.kept if fit.hypothesis.terms[term_index].scales),
    }
    elsewhere = {
        key
        for term_index in reported
        for term in [fit.hypothesis.terms[term_index]]
        for key in (*term.opens, *term.scales)
    }
    bounded, written = on_bound(fit), fit.hypothesis.written(fit.coordinates)
    found = {}
    for index, (unknown, nominal) in enumerate(zip(fit.hypothesis.unknowns, fit.hypothesis.base, strict=False)):
        along = _along(fit, index, unknown.key)
        value = get(written, unknown.key) if along.sum() > 1.0 else fit.values[index]
        half = SETTINGS.intervals.z95 * math.sqrt(max(float(along @ judgement.covariance @ along), 0.0))
        size = unknown.size if unknown.size else abs(value)
        if unknown.key in elsewhere or bounded[index] or unknown.key.startswith(DRIVE):
            continue
        if abs(value - nominal.start) <= max(SETTINGS.intervals.least_change, half) * size:
            continue
        half *= size
        found[unknown.key] = FittedValue(value, unknown.unit, value - half, value + half, nominal.start)
    return found | _parts_of_map(judgement)


def _parts_of_map(judgement: JudgedSelection) -> dict[str, FittedValue]:
    """Factors under their level on the dry or the viscous part of a friction map, which no number of the model says."""
    fit, found = judgement.fit, {}
    for term_index, term in enumerate(fit.hypothesis.terms):
        if term_index in judgement.named or term_index in judgement.kept or MAP not in term.scales:
            continue
        index = fit.hypothesis.share(term_index).start
        value = fit.values[index]
        half = SETTINGS.intervals.z95 * math.sqrt(max(float(judgement.covariance[index, index]), 0.0))
        if abs(value - 1.0) > max(SETTINGS.intervals.least_change, half) * value:
            part = f"friction.{term.effect.removesuffix('_friction')}_part"
            found[part] = FittedValue(value, "times the map's", value * (1.0 - half), value * (1.0 + half), 1.0)
    return found


def _along(fit: Fit, index: int, key: str) -> Array:
    """The coordinates whose sum is the logarithm of a number of the model's own: its own, and factors on it."""
    along = np.zeros(len(fit.coordinates))
    along[index] = 1.0
    for term_index, term in enumerate(fit.hypothesis.terms):
        if key in term.scales:
            along[fit.hypothesis.share(term_index).start] = 1.0
    return along


def fitted_drive(judgement: JudgedSelection) -> dict[str, FittedValue]:
    """What was unknown of the drive, with its 95 % intervals."""
    fit, found = judgement.fit, {}
    for index, unknown in enumerate(fit.hypothesis.base):
        if unknown.key.startswith(DRIVE):
            value = fit.values[index]
            spread = SETTINGS.intervals.z95 * math.sqrt(max(float(judgement.covariance[index, index]), 0.0))
            scale = unknown.size * spread
            ends = (value - scale, value + scale) if scale else (value * math.exp(-spread), value * math.exp(spread))
            found[unknown.key.removeprefix(DRIVE)] = FittedValue(value, unknown.unit, *ends)
    return found


def extended_model(judgement: JudgedSelection, nominal: AxisModel) -> AxisModel:
    """The axis model with the physics added.

    A disturbance that stood in one recording is an event, no physics of the axis, and stays out.
    """
    fit = judgement.fit
    document: Document = fit.hypothesis.written(_model_coordinates(judgement))
    document.pop(NAME, None)
    values = fit.values
    for index, term in enumerate(fit.hypothesis.terms):
        if term.effect == NAME and term.form == EVERY:
            start, length, torque = values[fit.hypothesis.share(index)]
            rows = document.setdefault(NAME, {}).setdefault("windows", [])
            rows.append({"start_s": start, "end_s": start + length, "torque": torque})
    if judgement.residual is not None:
        write_table(document, judgement.residual)
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
    changed = [*recalibrated(judgement), *(f"{DRIVE}{key}" for key in fitted_drive(judgement))]
    pairs = zip(fit.hypothesis.base, on_bound(fit), strict=False)
    moved = [unknown.key in changed or bounded for unknown, bounded in pairs]
    back = np.where(moved, 0.0, fit.coordinates - fit.hypothesis.start)
    return fit.coordinates - back if inside_region(back, judgement.covariance) else fit.coordinates


def free_windows(judgement: JudgedSelection, nominal: AxisModel) -> tuple[Windows, ...]:
    """Errors of free windows, by models that were fitted without the rows; what has no name is a table in them."""
    predictor, after = judgement.predictor, judgement.tables or judgement.validation.after.folds
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


# --- Findings and minor terms ----------------------------------------------------------------------------------------
# Which terms of the last fit are findings, and why the others are none: the levels of the outside contract once more. A
# term comes in by what it takes when it comes; beside those that come later it may be worth less. It stays in the model
# then, for the others were fitted beside it, and is listed with its values as minor, unless it is a resonance. One
# whose numbers are pushed to an end of their range is somebody else's shape: it goes, and what it took counts as left.
# So does one that is not told from none, unless rows that no fit has seen are predicted worse without it.
#
# The contract counts shares of the error on unseen rows. A drift of the constant torque is next to nothing in any row
# and adds up in every simulation that runs freely: its share is that of the means over a second, where it shows.


#: Numbers that say where or when a term acts, whatever its size.
WHERE = frozenset(("shift", "torque_at_middle", "start_s", "position", "behind"))

#: Sizes that are positive by themselves, so that only their interval tells them from nothing.
POSITIVE = frozenset(("time_constant_s", "gap"))


def name_findings(selector: Selector, judgement: JudgedSelection) -> JudgedSelection:
    """The judgement with those named that are findings beside all others, and why the rest of the terms is none.

    What each term is worth is said again. Terms of one effect are one finding, if one of them is.
    """
    fit, selection = judgement.fit, judgement.selection
    for index in judgement.named:
        merit = selector.merit(selection, judgement.validation.reduced[index], fit)
        selection = selection.with_merit(index, merit)
    judgement = replace(judgement, selection=selection)
    why = {index: _reason(judgement, index) for index in judgement.named}
    names = {fit.hypothesis.terms[index].effect for index, reason in why.items() if reason is None}
    named = tuple(index for index in judgement.named if fit.hypothesis.terms[index].effect in names)
    kept = {index: reason for index, reason in why.items() if reason is not None and index not in named}
    return replace(judgement, named=named, kept=kept | _under_level(judgement))


def reject_terms(selector: Selector, judgement: JudgedSelection) -> Selection | None:
    """The selection without the terms that were rejected, and those that follow from them; None where none was.

    A value at the end of its range has not been measured, and what such a term takes is not explained by it. One whose
    numbers are only told from none together gives way to a plainer form of its effect first, where there is one.
    """
    unsure = [index for index, why in judgement.kept.items() if why is MinorReason.UNSURE]
    for index in unsure:
        plainer = plainer_form(selector, judgement.selection, index)
        if plainer is not None and differ_together(judgement.fit, index, judgement.covariance):
            return plainer
    rejected = sorted(index for index, why in judgement.kept.items() if _goes(judgement, index, why))
    selection = judgement.selection
    terms = selection.fit.hypothesis.terms
    why = {terms[index].effect: (selection.merits[index], judgement.kept[index]) for index in rejected}
    for index in reversed(rejected):
        selection = selection.without_term(index, selector.settle_without(selection.fit, index))
    return replace(selection, rejected={**selection.rejected, **why}) if rejected else None


def plainer_form(selector: Selector, selection: Selection, index: int) -> Selection | None:
    """The selection with the best form of a term's effect that needs fewer numbers; None where there is none.

    Friction by the applied torque and by the load, both at once, is sure together and neither alone.
    """
    fit = selection.fit
    own, share = fit.hypothesis.terms[index], fit.hypothesis.share(index)
    scene = SearchContext(selector.start.document, selector.predictor, selection.base.mismatch)
    fits = []
    for term in effect(own.effect).terms(scene):
        if term.unknowns and term.numbers < own.numbers:
            terms = (*fit.hypothesis.terms[:index], term, *fit.hypothesis.terms[index + 1 :])
            start = [unknown.coordinate(unknown.start) for unknown in term.unknowns]
            at = np.concatenate([fit.coordinates[: share.start], start, fit.coordinates[share.stop :]])
            fits.append(selector.settle(replace(fit.hypothesis, terms=terms), at, fit.mismatch))
    if not fits:
        return None
    return replace(selection, fit=min(fits, key=lambda one: selector.error(one.mismatch)))


def _goes(judgement: JudgedSelection, index: int, why: MinorReason) -> bool:
    """Whether a term goes for a reason: one that is only not told from none stays where unseen rows need it.

    Not where a plainer effect is within it: what it took there is that one's. One that is too small for a name goes
    where it would add a resonance to the model.
    """
    if why is MinorReason.UNSURE:
        plainer = any(judgement.fit.hypothesis.terms[index].effect in one.within for one in effects())
        return plainer or judgement.removed_share(index) < SETTINGS.worth.share
    if why is MinorReason.SMALL:
        return effect(judgement.fit.hypothesis.terms[index].effect).resonant
    return why in {MinorReason.AT_END, MinorReason.BEYOND}


def _under_level(judgement: JudgedSelection) -> dict[int, MinorReason]:
    """Terms with numbers of their own that are under their level; what only changes the model's own is recalibrated."""
    twin = shorter_twin(judgement.fit)
    terms = enumerate(judgement.fit.hypothesis.terms)
    return {
        index: MinorReason.TWIN if term.effect == twin else MinorReason.LEVEL
        for index, term in terms
        if index not in judgement.named and term.unknowns and not term.scales
    }


def _reason(judgement: JudgedSelection, index: int) -> MinorReason | None:
    """Why a term is no finding; None if it is one."""
    fit = judgement.fit
    merit = replace(judgement.selection.merits[index], share=_share(judgement, index))
    if not large_enough(merit, is_level_change(fit.hypothesis.terms[index])):
        return MinorReason.SMALL
    if at_end_of_range(fit, index):
        return MinorReason.AT_END
    if exceeds_command(judgement, index):
        return MinorReason.BEYOND
    return None if differs_from_zero(fit, index, judgement.covariance) else MinorReason.UNSURE


def exceeds_command(judgement: JudgedSelection, index: int) -> bool:
    """Whether a term makes torques that nothing in the recordings holds against: units are mixed up then.

    Factors on the model's own, or on the command, are judged by their ranges.
    """
    term, predictor = judgement.fit.hypothesis.terms[index], judgement.predictor
    if term.scales or effect(term.effect).scales_torques or effect(term.effect).drive_keys:
        return False
    largest = float(np.max(np.abs(predictor.over("torque"))))
    return judgement.selection.merits[index].own * predictor.dry > SETTINGS.worth.most_of_command * largest


def _share(judgement: JudgedSelection, index: int) -> float:
    """The share of the explainable error on unseen rows that a term takes, where it shows."""
    rows = judgement.removed_share(index)
    if judgement.fit.hypothesis.terms[index].effect != DRIFT[0]:
        return rows
    validation = judgement.validation
    parts = (validation.without[index], validation.after, validation.before)
    without, after, before = (power_of_means(judgement.predictor, held.mismatch) for held in parts)
    return max(rows, (without - after) / max(before, 1e-30))


def differs_from_zero(fit: Fit, index: int, covariance: Array) -> bool:
    """Whether nothing at all lies outside the region of 95 % of what says how large a term is.

    Numbers that are only sure together are not: one of them must lie outside its own interval around nothing too, lest
    a report show an effect none of whose numbers is told from none. A term whose size has no zero, such as a stiffness
    or a limit, is told by what it takes alone.
    """
    sizes = _sizes(fit, index)
    half = SETTINGS.intervals.z95 * np.sqrt(np.maximum(np.diag(covariance)[sizes], 0.0))
    alone = not sizes or bool(np.any(np.abs(fit.coordinates[sizes]) > half))
    return alone and differ_together(fit, index, covariance)


def differ_together(fit: Fit, index: int, covariance: Array) -> bool:
    """Whether nothing at all lies outside the region of 95 % of all sizes of a term."""
    unknowns, share = fit.hypothesis.unknowns, fit.hypothesis.share(index)
    own = range(share.start, share.stop)
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if any(unknowns[i].key in POSITIVE and SETTINGS.intervals.z95 * deviations[i] >= 1.0 for i in own):
        return False
    sizes = _sizes(fit, index)
    return not sizes or not inside_region(fit.coordinates[sizes], covariance[np.ix_(sizes, sizes)])


def _sizes(fit: Fit, term_index: int) -> list[int]:
    """Places of the coordinates of a term that say how large it is."""
    share = fit.hypothesis.share(term_index)
    return [index for index in range(share.start, share.stop) if _has_none(fit.hypothesis.unknowns[index])]


def _has_none(unknown: Unknown) -> bool:
    """Whether a coordinate of 0 says that a term is not there: a size of nothing, or a factor of one."""
    return unknown.key == LEVEL or (unknown.size != 0.0 and unknown.low <= 0.0 and unknown.key not in WHERE)
