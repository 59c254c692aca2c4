"""The outside contract's `diagnosis.json` and `model.yaml` from a diagnosis.

The last step before the files: plain numbers, sentences for people, nothing decided here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.disturbance import EVERY
from servod.lab.diagnose.effects.hypothesis import Document, Reported
from servod.lab.diagnose.judge.evidence import Diagnosis, Evidence
from servod.lab.diagnose.judge.held_out import Fold, WindowErrors, window_errors, windows_document
from servod.lab.diagnose.judge.locate import places
from servod.lab.diagnose.judge.spread import within
from servod.lab.diagnose.judge.verdict import alternatives, confidence
from servod.lab.diagnose.predict.coordinates import units, where
from servod.lab.diagnose.predict.floor import trace_floor
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit
from servod.lab.diagnose.settings import SETTINGS

# What these recordings say of the model's own parameters: which have changed, in numbers, in a sentence, in the model.
#
# Stands between the evidence and the document.


def recalibrated(evidence: Evidence) -> dict[str, Any]:
    """Parameters of the model itself that were off: from, to, 95 % interval. Those of a finding are not here."""
    fit = evidence.fit
    opened = {key for place in evidence.named for key in fit.hypothesis.terms[place].opens}
    found = {}
    for index, (unknown, nominal) in enumerate(zip(fit.hypothesis.unknowns, fit.hypothesis.base, strict=False)):
        value = fit.values[index]
        deviation = math.sqrt(max(float(evidence.spread[index, index]), 0.0))
        size = unknown.size if unknown.size else abs(value)
        half = SETTINGS.intervals.z95 * deviation
        if unknown.key in opened or abs(value - nominal.start) <= max(SETTINGS.intervals.least_change, half) * size:
            continue
        half *= size
        entry = {"from": nominal.start, "to": value, "unit": unknown.unit, "interval": [value - half, value + half]}
        found[unknown.key] = entry
    return found


def told_coordinates(evidence: Evidence) -> Array:
    """Coordinates of the model to hand out: what the report says, as long as that can be said.

    Where nothing has a name, parameters that are not told from what they were stay what they were: those of an axis
    that was identified are worth more than what one short recording makes of them. That holds as long as all of them
    together lie in the region of 95 % around the fit; beyond it, the fit.
    """
    fit = evidence.fit
    if fit.hypothesis.terms or evidence.unnamed is not None:
        return fit.coordinates
    changed = recalibrated(evidence)
    told = [unknown.key in changed for unknown in fit.hypothesis.base]
    back = np.where(told, 0.0, fit.coordinates - fit.hypothesis.start)
    return fit.coordinates - back if within(back, evidence.spread) else fit.coordinates


def differs(changes: Mapping[str, Any]) -> str:
    """What was recalibrated, as a sentence about these recordings; empty where nothing was."""
    said = []
    for name, change in changes.items():
        words = name.removeprefix("friction.").removesuffix(".per_s").removesuffix("_s").replace("_", " ")
        was, now, unit = change["from"], change["to"], change["unit"]
        share = f" ({100.0 * (now - was) / abs(was):+.2g} %)" if was != 0.0 else ""
        said.append(f"{words} is {now:.4g} instead of {was:.4g} {unit}{share}")
    return f"What differs from the model in these recordings: {'; '.join(said)}." if said else ""


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
            half = SETTINGS.intervals.z95 * deviation
            low, high = reported.value - half, reported.value + half
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


# What the report says in plain sentences: the verdict, how sure, what remains, and what to record next.
#
# Stands on the document of a diagnosis alone.


#: What to do about a refused recording, by a word of the reason.
REMEDIES = {
    "too short": "Record for at least some seconds; three recordings of 15 s are usual.",
    "too still": "Let the axis move: slow sines, a mix of frequencies, and moves with rests in between.",
    "too noisy": "The encoder's noise hides what friction does: use a finer encoder, or move faster and further.",
    "saturated": "The drive was at its limit: ask for slower motions, so that the command is what acts.",
    "opposite signs": "Turn the sign of the command or of the position in a --map file (scale: -1).",
    "another unit": "Give the unit in a --map file (scale: 0.001 turns mN·m into N·m).",
    "degrees": "Give the unit in a --map file (scale: 0.0174533 turns degrees into rad).",
    "counts": "Give the unit in a --map file (scale: 2*pi over the counts of a turn).",
    "never changes": "Record the command that goes to the drive, not a constant.",
}

#: How the diagnosis works, for those who want to know.
MATHEMATICS = (
    "Prediction. The model is simulated under the recorded command and pulled to the recorded position by an observer "
    "of fixed gains. The pull, as a torque, is the error shown here: where the model is right it is noise (Ljung, "
    "System Identification, 1999, ch. 7).",
    "Recalibration. The model's own parameters are fitted first, each within what a good model is known to (10 %), by "
    "damped Gauss-Newton with Huber's loss.",
    "Search. Every known effect is added in several forms and from many starts, together with all parameters of the "
    "model. It stays when the gain is significant against correlated noise with a correction for the number of things "
    "tried (Bayesian information criterion), and when it is large enough to be worth naming.",
    "Proof. Each recording in turn is left out, the rest is fitted again, and the one left out is predicted; a quarter "
    "of every recording where there is only one, or where recordings differ in a number of their own. Intervals "
    "count correlated rows as fewer (sums over blocks of a quarter of a second: Carlstein, Annals of Statistics 14, "
    "1986).",
)


def verdict_sentence(document: Document) -> str:
    """The answer in one or two sentences."""
    return str(document["summary"])


def certainty(finding: Document) -> list[str]:
    """How sure a finding is, and what it cannot be told apart from."""
    name = finding["effect"].replace("_", " ")
    lines = [f"How sure that it is {name}: {100.0 * finding['confidence']:.0f} %."]
    for other in finding["alternatives"]:
        lines.append(
            f"These data cannot tell {name} from {other['effect'].replace('_', ' ')}; this would: "
            f"{other['experiment']}."
        )
    return lines


def remains(document: Document) -> str:
    """What is left, and where it lives."""
    fit, left = document["fit"], [m for m in document["remaining"] if m["chance"] < 1e-3 and m["share"] > 0.01]
    times = fit["held_out"]["after"] / max(fit["noise_floor"], 1e-30)
    if not left or times < 1.1:
        return "What is left is noise: no coordinate orders it any more."
    most = left[0]
    return (
        f"What is left is {times:.1f} times the noise floor; most of what is ordered in it lies over "
        f"{most['coordinate']} ({100.0 * most['share']:.0f} % of it)."
    )


def next_experiments(document: Document) -> list[str]:
    """What to record next: what separates the alternatives, and what would make a finding surer."""
    lines = []
    for finding in document["findings"]:
        name = finding["effect"].replace("_", " ")
        for other in finding["alternatives"]:
            lines.append(f"To tell {name} from {other['effect'].replace('_', ' ')}: {other['experiment']}.")
        lines.append(f"To see {name} by itself: {finding['experiment']}.")
    if document["verdict"] == "unexplained":
        where = document["located"][0]["coordinate"]
        lines.append(
            f"Repeat the recordings slower and faster, over the same range of {where}: what stays tied to the place is "
            "the axis, what stays tied to the time is its surroundings."
        )
    return list(dict.fromkeys(lines))
