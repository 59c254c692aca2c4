"""The outside contract's `diagnosis.json` and `model.yaml` from a diagnosis.

The last step before the files: plain numbers, sentences for people, nothing decided here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.disturbance import EVERY
from servod.lab.diagnose.effects.hypothesis import Document, Reported
from servod.lab.diagnose.engine import Diagnosis, Evidence
from servod.lab.diagnose.judge.held_out import Fold
from servod.lab.diagnose.judge.locate import places
from servod.lab.diagnose.judge.verdict import alternatives, confidence
from servod.lab.diagnose.judge.windows import WindowErrors, window_errors, windows_document
from servod.lab.diagnose.predict.coordinates import units
from servod.lab.diagnose.predict.floor import trace_floor
from servod.lab.diagnose.predict.signature import where
from servod.lab.diagnose.recalibrated import Z95, differs, recalibrated, told_coordinates
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit

Array = NDArray[np.float64]


def diagnosis_document(diagnosis: Diagnosis, windows: Sequence[WindowErrors] | None = None) -> dict[str, Any]:
    """The JSON document; `windows` are those of `window_evidence` where they have been computed already."""
    evidence = diagnosis.evidence
    told = units(diagnosis.nominal)
    found: dict[str, Any] = {"verdict": diagnosis.verdict.value, "summary": summary(diagnosis)}
    found["findings"] = findings(evidence) if evidence else []
    found["recalibrated"] = recalibrated(evidence) if evidence else {}
    found["summary"] = " ".join(part for part in (found["summary"], differs(found["recalibrated"])) if part)
    found["minor"] = minor(evidence) if evidence else {}
    found["fit"] = fit_document(diagnosis, evidence, windows) if evidence else {}
    if evidence is not None and evidence.unnamed is not None:
        left = evidence.unnamed
        table = {"grid": left.grid.tolist(), "torque": left.torque.tolist()}
        found["unexplained"] = {"coordinate": left.coordinate, "share": left.share, **table}
    if evidence is not None:
        found["located"] = [m.document() for m in evidence.maps_before]
        found["remaining"] = [m.document() for m in evidence.maps_after]
    found["recordings"] = recordings(diagnosis)
    found["units"] = {"position": told.length, "torque": told.force}
    found["seconds"] = {stage: round(value, 2) for stage, value in diagnosis.seconds.items()}
    return found


def summary(diagnosis: Diagnosis) -> str:
    """One or two plain sentences."""
    evidence = diagnosis.evidence
    if evidence is None:
        reasons = "; ".join(f"{r.name}: {r.reason}" for r in diagnosis.refused)
        return f"These data cannot tell: {reasons}."
    found = _found(diagnosis, evidence)
    return f"{found} {cut_short(evidence.choice.tried)}" if evidence.choice.cut else found


def cut_short(tried: int) -> str:
    """That time ended the search while something was left, after so many starts of effects."""
    if tried == 0:
        return "The time limit was over before any physics was tried: give more time (--time-limit)."
    return f"The time limit ended the search after {tried} starts: with more time (--time-limit) the answer may change."


def _found(diagnosis: Diagnosis, evidence: Evidence) -> str:
    """What was found, when there was time for it."""
    names = list(dict.fromkeys(evidence.fit.hypothesis.terms[place].effect for place in evidence.named))
    if names:
        sentences = " ".join(f"{effect(name).statement}." for name in names)
        return f"{sentences} {100.0 * evidence.unseen.removed:.0f} % of the explainable mismatch is gone."
    if diagnosis.verdict.value == "cannot_tell":
        return _too_little(evidence)
    if diagnosis.verdict.value == "unexplained":
        where = evidence.maps_before[0].coordinate
        return f"Something is left that no known physics explains; it shows most over {where}."
    return "The model is adequate: nothing worth naming is left beyond the noise."


def _too_little(evidence: Evidence) -> str:
    """Why recordings that were taken in cannot tell after all."""
    if evidence.choice.cut:
        return "Something is left, and nothing can be told of it yet."
    noise, dry, force = evidence.predictor.encoder_noise, evidence.predictor.dry, units(evidence.predictor).force
    return (
        f"These data cannot tell: too noisy: noise and steps of the encoder make {noise:.3g} {force} of torque in each "
        f"row, dry friction is {dry:.3g} {force}."
    )


def findings(evidence: Evidence) -> list[dict[str, Any]]:
    """One entry for each effect; terms of the same effect are one finding."""
    terms = evidence.fit.hypothesis.terms
    names = list(dict.fromkeys(terms[place].effect for place in evidence.named))
    return [_finding(evidence, name, [p for p in evidence.named if terms[p].effect == name]) for name in names]


def _finding(evidence: Evidence, name: str, named: list[int]) -> dict[str, Any]:
    fit, first = evidence.fit, named[0]
    force = units(evidence.predictor).force
    what = effect(name)
    contribution = evidence.less[first].mismatch - fit.mismatch
    merit = evidence.choice.merits[first]
    located = places(evidence.predictor, contribution, evidence.predictor.dry)
    statement = (
        f"{what.statement}. It carries {100.0 * evidence.carries(first):.0f} % of the explainable mismatch and "
        f"{100.0 * merit.torque:.1f} % of dry friction where it acts. It shows as {what.shows}; it is strongest "
        f"{where(name, located)}."
    )
    others = [
        {"effect": other, "experiment": effect(other).experiment} for other in alternatives(evidence.choice, first)
    ]
    return {
        "effect": name,
        "statement": statement,
        "located": located,
        "form": [fit.hypothesis.terms[place].form for place in named],
        "parameters": _parameters(evidence, named),
        "confidence": min(confidence(evidence.choice, place, evidence.errors.removed) for place in named),
        "alternatives": others,
        "confused_with": list(what.confused),
        "experiment": what.experiment,
        "held_out": {"before": evidence.without[first].rms, "after": evidence.after.rms, "unit": force},
    }


def _parameters(evidence: Evidence, named: list[int]) -> dict[str, Any]:
    """Reported values of the terms with their 95 % intervals; later terms of the same effect are numbered."""
    found: dict[str, Any] = {}
    for count, place in enumerate(named):
        told = _told(evidence.fit, place, evidence.fit.coordinates)
        spread = _spread(evidence, place, told)
        for reported, deviation in zip(told, spread, strict=True):
            name = reported.name if count == 0 else f"{reported.name}_term{count + 1}"
            low, high = reported.value - Z95 * deviation, reported.value + Z95 * deviation
            found[name] = {"value": reported.value, "unit": reported.unit, "interval": [low, high]}
    return found


def _told(fit: Fit, place: int, coordinates: Array) -> list[Reported]:
    document = fit.hypothesis.written(coordinates)
    return fit.hypothesis.terms[place].tell(document, fit.hypothesis.values(coordinates)[fit.hypothesis.share(place)])


def _spread(evidence: Evidence, place: int, told: list[Reported]) -> Array:
    """Standard deviations of reported values, by their derivatives."""
    fit = evidence.fit
    slopes = np.zeros((len(told), len(fit.coordinates)))
    for index in range(len(fit.coordinates)):
        nudged = fit.coordinates.copy()
        nudged[index] += 1e-5
        there = _told(fit, place, nudged)
        slopes[:, index] = [(b.value - a.value) / 1e-5 for a, b in zip(told, there, strict=True)]
    variances = np.einsum("ij,jk,ik->i", slopes, evidence.spread, slopes)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def minor(evidence: Evidence) -> dict[str, Any]:
    """Effects that are there but not worth naming: torque as a share of dry friction, share of the error.

    Those that stand in the model have their parameters too, and why they are no findings.
    """
    terms = evidence.fit.hypothesis.terms
    named = {terms[place].effect for place in evidence.named}
    seen = {name: _size(merit) for name, merit in evidence.choice.minor.items() if name not in named}
    for name in dict.fromkeys(terms[place].effect for place in evidence.kept):
        those = [place for place in evidence.kept if terms[place].effect == name]
        largest = max((evidence.choice.merits[place] for place in those), key=lambda merit: merit.torque)
        why = evidence.kept[those[0]].value
        seen[name] = {**_size(largest), "why": why, "parameters": _parameters(evidence, those)}
    return seen


def _size(merit: Merit) -> dict[str, Any]:
    return {"torque_over_coulomb": round(merit.torque, 5), "share": round(max(merit.share, 0.0), 5)}


def fit_document(
    diagnosis: Diagnosis, evidence: Evidence, windows: Sequence[WindowErrors] | None = None
) -> dict[str, Any]:
    """Errors before and after on data that a fit has not seen, the floor, and windows simulated from the recording."""
    if windows is None:
        windows = window_evidence(diagnosis, evidence)
    return {
        "unit": units(evidence.predictor).force,
        "held_out": {"before": evidence.before.rms, "after": evidence.after.rms, **_shared(evidence)},
        "noise_floor": evidence.unseen.floor,
        "explainable_removed": round(evidence.unseen.removed, 4),
        "removed_by_known_physics": round(evidence.attempt, 4),
        "windows": windows_document(windows, evidence.predictor, evidence.shared.judged),
        "observer_rad_s": evidence.predictor.rate,
        "starts_tried": evidence.choice.tried,
        "cut_by_time": evidence.choice.cut,
    }


def _shared(evidence: Evidence) -> dict[str, Any]:
    """What was left out in turn, and for how long the recordings are not judged since only an event stands there."""
    predictor = evidence.predictor
    events = predictor.counts & ~evidence.shared.judged
    seconds = sum(
        trace.period_s * int(events[part].sum())
        for trace, part in zip(predictor.traces, predictor.slices, strict=True)
    )  # fmt: skip
    return {"left_out": evidence.shared.left_out, "not_judged_s": round(seconds, 3)}


def window_evidence(diagnosis: Diagnosis, evidence: Evidence) -> list[WindowErrors]:
    """Errors of free windows. What has no name is a table over everything, so that its rows have been seen."""
    after = evidence.after.folds
    if evidence.unnamed is not None:
        extended = extended_model(diagnosis)
        assert extended is not None  # there is evidence
        after = (Fold(np.ones(len(evidence.predictor.counts), dtype=bool), (extended,)),)
    return window_errors(evidence.predictor, diagnosis.nominal, evidence.before.folds, after)


def recordings(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """What was taken in and refused, with notes."""
    evidence = diagnosis.evidence
    taken = [_recording(evidence, index) for index in range(len(evidence.traces))] if evidence else []
    return taken + [{"name": r.name, "taken": False, "reason": r.reason} for r in diagnosis.refused]


def _recording(evidence: Evidence, index: int) -> dict[str, Any]:
    """One recording: what was repaired, its noise, and its mismatch by fits that have not seen the rows."""
    trace, part, predictor = evidence.traces[index], evidence.predictor.slices[index], evidence.predictor
    rows, judged = predictor.counts[part], evidence.shared.judged[part]
    return {
        "name": trace.name,
        "taken": True,
        "duration_s": trace.duration_s,
        "rows": int(rows.sum()),
        "period_s": trace.period_s,
        "position_noise": trace.position_noise,
        "notes": list(trace.notes),
        "noise_floor": math.sqrt(trace_floor(predictor, index, evidence.fit.mismatch)),
        "mismatch_before": _rms(evidence.before.mismatch[part][judged]),
        "mismatch_after": _rms(evidence.after.mismatch[part][judged]),
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def extended_model(diagnosis: Diagnosis) -> AxisModel | None:
    """The axis model with the physics added; None when nothing could be told.

    A disturbance that stood in one recording is an event, no physics of the axis, and stays out.
    """
    evidence = diagnosis.evidence
    if evidence is None:
        return None
    fit = evidence.fit
    document: Document = fit.hypothesis.written(told_coordinates(evidence))
    document.pop("disturbance", None)
    values = fit.values
    for place, term in enumerate(fit.hypothesis.terms):
        if term.effect == "disturbance" and term.form == EVERY:
            start, length, torque = values[fit.hypothesis.share(place)]
            rows = document.setdefault("disturbance", {}).setdefault("windows", [])
            rows.append({"start_s": start, "end_s": start + length, "torque": torque})
    if evidence.unnamed is not None:
        evidence.unnamed.write(document)
    if diagnosis.nominal.noise is not None:
        document["noise"] = diagnosis.nominal.noise.model_dump(mode="json", exclude_none=True)
    return AxisModel.model_validate(document)
