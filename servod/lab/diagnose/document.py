"""The outside contract's `diagnosis.json` from a diagnosis, and what is said of it in sentences.

The last step before the files: it formats a finished result and computes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.result import (
    Diagnosis,
    DiagnosisVerdict,
    Evidence,
    FittedValue,
    FreeRun,
    HeldOutRecording,
    Minor,
    MinorReason,
    MismatchMap,
    NamedEffect,
    PartialAnswer,
    Quality,
    RecordingErrors,
    RefusedRecording,
)

Document = dict[str, Any]


def diagnosis_document(diagnosis: Diagnosis) -> Document:
    """The JSON document."""
    evidence = diagnosis.evidence
    found: Document = {"verdict": diagnosis.verdict.value, "summary": summary(diagnosis)}
    found["findings"] = [_finding(one, diagnosis.units.force) for one in evidence.findings] if evidence else []
    found["recalibrated"] = _recalibrated(evidence.recalibrated) if evidence else {}
    if evidence is not None and evidence.drive:
        found["drive"] = _parameters(evidence.drive)
    found["minor"] = {name: _minor(one) for name, one in evidence.minor.items()} if evidence else {}
    found["fit"] = _fit(diagnosis, evidence) if evidence else {}
    if evidence is not None and evidence.residual is not None:
        left = evidence.residual
        table = {"grid": left.grid.tolist(), "torque": left.torque.tolist()}
        found["unexplained"] = {"coordinate": left.coordinate, "share": left.share, **table}
    if evidence is not None and evidence.partial is not None:
        found["partial"] = _partial(evidence.partial)
    if evidence is not None:
        found["located"] = [_map(one) for one in evidence.maps_before]
        found["remaining"] = [_map(one) for one in evidence.maps_after]
    found["recordings"] = [_recording(one) for one in evidence.recordings] if evidence else []
    found["recordings"] += [_refused(one) for one in diagnosis.refused]
    if diagnosis.held_out:
        found["held_out"] = {one.name: _held_out(one, diagnosis.units.length) for one in diagnosis.held_out}
    found["units"] = {"position": diagnosis.units.length, "torque": diagnosis.units.force}
    found["seconds"] = {stage: round(value, 2) for stage, value in diagnosis.seconds.items()}
    return found


def summary(diagnosis: Diagnosis) -> str:
    """A few plain sentences."""
    evidence = diagnosis.evidence
    if evidence is None:
        reasons = "; ".join(f"{r.name}: {r.reason}" for r in diagnosis.refused)
        return f"These data cannot tell: {reasons}."
    cut = describe_cut(evidence.search.starts_tried) if evidence.search.cut_by_time else ""
    said = _found(diagnosis, evidence), describe_oversized(evidence), cut, describe_changes(evidence.recalibrated)
    return " ".join(part for part in said if part)


def describe_oversized(evidence: Evidence) -> str:
    """Effects that got no name since they would need torques beyond the recordings', as a sentence; empty for none."""
    oversized = [name.replace("_", " ") for name, one in evidence.minor.items() if one.why is MinorReason.BEYOND]
    if not oversized:
        return ""
    return (
        f"No name is given to {' and '.join(oversized)}: it would take many times the largest torque of these "
        "recordings. Look at the units of command and position (unit: in a --map file), and at the drive's factor."
    )


def describe_cut(tried: int) -> str:
    """That time ended the search while something was left, after so many starts of effects."""
    if tried == 0:
        return "The time limit was over before any physics was tried: give more time (--time-limit)."
    return f"The time limit ended the search after {tried} starts: with more time (--time-limit) the answer may change."


def describe_changes(changes: Mapping[str, FittedValue]) -> str:
    """What was recalibrated, as a sentence about these recordings; empty where nothing was."""
    said = []
    for name, change in changes.items():
        words = name.removeprefix("friction.").removesuffix(".per_s").removesuffix("_s").replace("_", " ")
        was, now = change.nominal or 0.0, change.value
        share = f" ({100.0 * (now - was) / abs(was):+.2g} %)" if was != 0.0 else ""
        said.append(f"{words} is {now:.4g} instead of {was:.4g} {change.unit}{share}")
    return f"What differs from the model in these recordings: {'; '.join(said)}." if said else ""


def _found(diagnosis: Diagnosis, evidence: Evidence) -> str:
    """What was found, when there was time for it."""
    if evidence.findings:
        sentences = " ".join(f"{_statement(one)}." for one in evidence.findings)
        return f"{sentences} {100.0 * evidence.quality.removed:.0f} % of the explainable mismatch is gone."
    if diagnosis.verdict is DiagnosisVerdict.CANNOT_TELL:
        return _too_little(diagnosis, evidence)
    if diagnosis.verdict is DiagnosisVerdict.UNEXPLAINED:
        where = evidence.maps_before[0].coordinate
        return f"Something is left that no known physics explains; it shows most over {where}.{_part(evidence)}"
    return "The model is adequate: nothing worth naming is left beyond the noise."


def _statement(found: NamedEffect) -> str:
    """What was left out; of a number of the model's own, by how much it is off."""
    said, over = effect(found.effect).statement, found.parameters.get("over_model")
    if found.product_with:
        product = f"{found.effect.replace('_', ' ')} and {found.product_with.replace('_', ' ')}"
        return f"{said}; only the product of {product} shows, since the servo is hardly ever at its limit"
    return said if over is None else f"{said}, {over.value:.3g} times what the model says"


def _part(evidence: Evidence) -> str:
    """What known physics explains of it, as a sentence behind another; empty where it explains little."""
    part = evidence.partial
    if part is None:
        return ""
    names = " and ".join(f"{one.effect.replace('_', ' ')} ({100.0 * one.share:.0f} %)" for one in part.effects)
    return f" Part of it goes with {names}; the rest shows most over {part.rest} and has no name."


def _too_little(diagnosis: Diagnosis, evidence: Evidence) -> str:
    """Why recordings that were taken in cannot tell after all."""
    if evidence.search.cut_by_time:
        return "Something is left, and nothing can be told of it yet."
    noise, dry, force = evidence.encoder_noise, evidence.dry_friction, diagnosis.units.force
    return (
        f"These data cannot tell: too noisy: noise and steps of the encoder make {noise:.3g} {force} of torque in each "
        f"row, dry friction is {dry:.3g} {force}."
    )


def _finding(found: NamedEffect, force: str) -> Document:
    what = effect(found.effect)
    statement = (
        f"{_statement(found)}. It carries {100.0 * found.removed_share:.0f} % of the explainable mismatch and "
        f"{100.0 * found.torque:.1f} % of dry friction where it acts. It shows as {what.shows}; it is strongest "
        f"{describe_place(found.effect, found.located)}."
    )
    return {
        "effect": found.effect,
        "statement": statement,
        "located": dict(found.located),
        "form": list(found.forms),
        "parameters": _parameters(found.parameters),
        "confidence": found.confidence,
        "alternatives": [{"effect": other, "experiment": effect(other).experiment} for other in found.alternatives],
        "confused_with": list(what.confused),
        "experiment": what.experiment,
        "held_out": {"before": found.without, "after": found.after, "unit": force},
    }


def _partial(found: PartialAnswer) -> Document:
    effects = [
        {"effect": one.effect, "share": round(one.share, 4), "parameters": _parameters(one.parameters)}
        for one in found.effects
    ]
    return {"effects": effects, "share": round(found.share, 4), "rest": found.rest}


def _parameters(found: Mapping[str, FittedValue]) -> Document:
    return {name: {"value": p.value, "unit": p.unit, "interval": [p.low, p.high]} for name, p in found.items()}


def _recalibrated(found: Mapping[str, FittedValue]) -> Document:
    return {
        name: {"from": p.nominal, "to": p.value, "unit": p.unit, "interval": [p.low, p.high]}
        for name, p in found.items()
    }


def _minor(found: Minor) -> Document:
    size: Document = {"torque_over_coulomb": round(found.torque, 5), "share": round(found.share, 5)}
    if found.why is None or found.parameters is None:
        return size
    return {**size, "why": found.why.value, "parameters": _parameters(found.parameters)}


def _fit(diagnosis: Diagnosis, evidence: Evidence) -> Document:
    """Errors before and after on data that a fit has not seen, the floor, and windows simulated from the recording."""
    quality, search = evidence.quality, evidence.search
    left_out = {"left_out": quality.left_out, "not_judged_s": round(quality.not_judged_s, 3)}
    return {
        "unit": diagnosis.units.force,
        "held_out": {"before": quality.before, "after": quality.after, **left_out},
        "noise_floor": quality.noise_floor,
        "explainable_removed": round(quality.removed, 4),
        "removed_by_known_physics": round(quality.removed_by_known, 4),
        "windows": _windows(quality, diagnosis.units.length),
        "observer_rad_s": search.observer_rad_s,
        "starts_tried": search.starts_tried,
        "cut_by_time": search.cut_by_time,
    }


def _windows(quality: Quality, unit: str) -> Document:
    found: Document = {}
    for window in quality.windows:
        each = {name: _free_run(errors) for name, errors in window.recordings.items()}
        found[f"{window.horizon_s:g}"] = {"unit": unit, **_free_run(window.errors), "recordings": each}
    return found


def _held_out(found: HeldOutRecording, unit: str) -> Document:
    return {
        f"{w.horizon_s:g}": {"unit": unit, "before": w.before, "after": w.after, "coasting": w.coasting}
        for w in found.windows
    }


def _free_run(errors: FreeRun) -> Document:
    return {"before": errors.before, "recalibrated": errors.recalibrated, "after": errors.after}


def _map(found: MismatchMap) -> Document:
    return {
        "coordinate": found.coordinate,
        "unit": found.unit,
        "share": round(found.share, 4),
        "chance": found.chance,
        "at": found.at.tolist(),
        "mean": found.mean.tolist(),
        "error": found.error.tolist(),
    }


def _refused(found: RefusedRecording) -> Document:
    return {"name": found.name, "taken": False, "reason": found.reason, "notes": list(found.notes)}


def _recording(found: RecordingErrors) -> Document:
    return {
        "name": found.name,
        "taken": True,
        "duration_s": found.duration_s,
        "rows": found.rows,
        "period_s": found.period_s,
        "position_noise": found.position_noise,
        "notes": list(found.notes),
        "noise_floor": found.noise_floor,
        "mismatch_before": found.before,
        "mismatch_after": found.after,
    }


#: How a range of a coordinate is said.
_SAID = {
    "position": "at positions from {low} to {high} {unit}",
    "velocity": "at velocities from {low} to {high} {unit}",
    "acceleration": "at accelerations from {low} to {high} {unit}",
    "load": "at commands from {low} to {high} {unit}",
    "change of the command": "where the command changes by {low} to {high} {unit}",
    "time since reversal": "from {low} to {high} {unit} after a reversal",
    "temperature": "from {low} to {high} {unit}",
}


def describe_place(name: str, located: Mapping[str, Any]) -> str:
    """Where the effect is strongest, as the end of a sentence: its own coordinate, and recording and time."""
    said = []
    coordinate = effect(name).look.coordinate
    found = located.get(coordinate.replace(" ", "_"))
    if found is not None and coordinate in _SAID:
        ends = {"low": f"{found['from']:.3g}", "high": f"{found['to']:.3g}", "unit": found["unit"]}
        said.append(_SAID[coordinate].format(**ends))
    shares: Mapping[str, float] = located["recordings"]
    most = max(shares, key=lambda name: shares[name])
    window = next((w for w in located["time_windows"] if w["recording"] == most), None)
    if window is not None:
        said.append(f"in {most} from {window['start_s']:.2f} to {window['end_s']:.2f} s")
    return ", most of all ".join(said)


# --- Sentences of the report -----------------------------------------------------------------------------------------
# What the report says in plain sentences: the verdict, how sure, what remains, and what to record next.


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
    "of it where there is only one. Intervals "
    "count correlated rows as fewer (sums over blocks of a quarter of a second: Carlstein, Annals of Statistics 14, "
    "1986).",
)


def verdict_sentence(document: Document) -> str:
    """The answer in one or two sentences."""
    return str(document["summary"])


def describe_certainty(finding: Document) -> list[str]:
    """How sure a finding is, and what it cannot be told apart from."""
    name = finding["effect"].replace("_", " ")
    lines = [f"How sure that it is {name}: {100.0 * finding['confidence']:.0f} %."]
    for other in finding["alternatives"]:
        lines.append(
            f"These data cannot tell {name} from {other['effect'].replace('_', ' ')}; this would: "
            f"{other['experiment']}."
        )
    return lines


#: An error of less than so many times the noise floor is noise.
_NOISE = 1.1


def describe_fit(document: Document) -> str:
    """What the fit changed on rows that it has not seen. A change within the noise is called no gain."""
    fit, held = document["fit"], document["fit"]["held_out"]
    before, after, floor, unit = held["before"], held["after"], fit["noise_floor"], fit["unit"]
    begins = f"On rows that the fit has not seen ({held['left_out']} was left out) the torque error"
    noise = f"the noise floor is {floor:.3g} {unit}"
    if before < _NOISE * floor:
        return (
            f"{begins} is {before:.3g} {unit} without and {after:.3g} {unit} with the fit; {noise}. Both are within "
            "the noise: the difference says nothing."
        )
    if after >= before:
        return f"{begins} did not become less: {before:.3g} before, {after:.3g} {unit} after; {noise}."
    return (
        f"{begins} went from {before:.3g} to {after:.3g} {unit}; {noise}. "
        f"{100.0 * fit['explainable_removed']:.0f} % of what could be explained is gone"
        + (", and what is left is within the noise." if after < _NOISE * floor else ".")
    )


def describe_rest(document: Document) -> str:
    """What is left, and where it lives."""
    fit, left = document["fit"], [m for m in document["remaining"] if m["chance"] < 1e-3 and m["share"] > 0.01]
    times = fit["held_out"]["after"] / max(fit["noise_floor"], 1e-30)
    if not left or times < _NOISE:
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
