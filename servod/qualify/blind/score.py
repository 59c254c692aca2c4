"""Opens the seal and scores every answer by the rules of the outside contract.

The third of the three processes. Right is: every concealed effect named and nothing else; `adequate` where nothing is
hidden; no known name where physics is on nobody's list. Delay and lag count as one where the answer says that these
data cannot tell them apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from servod.common.errors import ServodError
from servod.common.files import read_json
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.recordings import load_recording
from servod.lab.simulate.replay import Drive, replay
from servod.qualify.blind import listed
from servod.qualify.blind.conceal import CASES, HOLDOUT, SEALED
from servod.qualify.blind.examine import ANSWERS, DIAGNOSIS, MODEL, RUN
from servod.qualify.blind.plan import Sort

#: Windows of the hold-out, s.
HORIZON_S = 0.25

#: Names that count as one where the answer gives one and calls the other an alternative.
TWINS = {listed.DELAY: listed.ACTUATOR_LAG, listed.ACTUATOR_LAG: listed.DELAY}

#: An answer that never came.
NO_ANSWER = "no answer"


@dataclass(frozen=True)
class Guess:
    """One finding: its name, how sure the answer is, and whether it is there."""

    effect: str
    confidence: float
    right: bool


@dataclass(frozen=True)
class Parameter:
    """One parameter of a right finding: its error as a share, and whether the 95 % interval covers the truth.

    One that the finding does not tell, as when it took another form than the plant's, counts as told to be nothing.
    """

    effect: str
    name: str
    error: float
    covered: bool
    reported: bool = True


@dataclass(frozen=True)
class HeldOut:
    """Position errors of windows on the recording that was held out, RMS in rad; NaN where there is no such model."""

    before: float
    after: float
    own: float


@dataclass(frozen=True)
class Scored:
    """One case with its answer."""

    name: str
    truth: Mapping[str, Any]
    verdict: str
    guesses: tuple[Guess, ...]
    right: bool
    parameters: tuple[Parameter, ...]
    held_out: HeldOut
    run: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sort(self) -> Sort:
        """What kind of answer is right."""
        return Sort(self.truth["sort"])


def score_case(out: Path, name: str, truth: Mapping[str, Any]) -> Scored:
    """Score one case of the trial in `out`."""
    answer = _read(out / ANSWERS / name / DIAGNOSIS)
    findings = answer.get("findings", [])
    verdict = str(answer.get("verdict", NO_ANSWER))
    matched = {finding["effect"]: matches(finding, truth["effects"]) for finding in findings}
    guesses = tuple(Guess(f["effect"], float(f["confidence"]), bool(matched[f["effect"]])) for f in findings)
    parameters = tuple(
        parameter
        for finding in findings
        if matched[finding["effect"]] == finding["effect"]
        for parameter in parameters_of(finding, truth)
    )
    return Scored(
        name,
        truth,
        verdict,
        guesses,
        is_right(Sort(truth["sort"]), verdict, set(matched.values()), truth["effects"]),
        parameters,
        held_out(out, name, truth),
        _read(out / ANSWERS / name / RUN),
    )


def matches(finding: Mapping[str, Any], effects: list[str]) -> str | None:
    """The concealed effect that a finding names; None when there is no such effect."""
    name = finding["effect"]
    if name in effects:
        return str(name)
    twin = TWINS.get(name)
    others = {other["effect"] for other in finding["alternatives"]}
    return twin if twin in effects and twin in others else None


def is_right(sort: Sort, verdict: str, matched: set[str | None], effects: list[str]) -> bool:
    """Whether verdict and names are the right answer."""
    if sort is Sort.NOTHING:
        return verdict == "adequate" and not matched
    if sort is Sort.UNKNOWN:
        return verdict not in (NO_ANSWER, "cannot_tell") and not matched
    return matched == set(effects)


def parameters_of(finding: Mapping[str, Any], truth: Mapping[str, Any]) -> list[Parameter]:
    """The truth's parameters as a right finding tells them; those that it does not tell are misses."""
    true: Mapping[str, float] = truth["parameters"][finding["effect"]]
    found = []
    for name, value in true.items():
        fitted = finding["parameters"].get(name)
        if fitted is None:
            found.append(Parameter(finding["effect"], name, 1.0, covered=False, reported=False))
            continue
        off = float(fitted["value"]) - value
        low, high = (float(bound) - value for bound in fitted["interval"])
        if name == "phase":
            turns = 2.0 * math.pi * round(off / (2.0 * math.pi))
            off, low, high = off - turns, low - turns, high - turns
        scale = scale_of(name, value, true)
        found.append(Parameter(finding["effect"], name, abs(off) / scale, low <= 0.0 <= high))
    return found


def scale_of(name: str, value: float, true: Mapping[str, float]) -> float:
    """What an error of a parameter is a share of: itself, but for what has no natural zero or is near one."""
    if name == "phase":
        return 1.0
    if name in ("negative_over_positive", "factor", "negative_factor") and "position" not in true:
        return max(abs(value - 1.0), 1e-9)
    if name in ("start_s", "end_s"):
        return true["end_s"] - true["start_s"]
    if name in ("rest", "position"):
        return max(abs(value), 0.5)
    return max(abs(value), 1e-12)


def held_out(out: Path, name: str, truth: Mapping[str, Any]) -> HeldOut:
    """Errors of windows by the believed, the extended and the true model."""
    drive = load_recording(out / SEALED / name / f"{HOLDOUT}.csv.gz", None).drive
    before = load_axis_model(out / CASES / name / MODEL)
    try:
        after = load_axis_model(out / ANSWERS / name / MODEL)
    except ServodError:
        after = before  # no model is no improvement
    own = AxisModel.model_validate(truth["true_model"]) if truth["true_model"] else None
    return HeldOut(_error(before, drive), _error(after, drive), _error(own, drive) if own else math.nan)


def _error(model: AxisModel, drive: Drive) -> float:
    return replay(model, drive, HORIZON_S).rms


def _read(path: Path) -> dict[str, Any]:
    """A document; nothing where none was written."""
    if not path.exists():
        return {}
    found: dict[str, Any] = read_json(path, "what `servoctl prove` wrote")
    return found
