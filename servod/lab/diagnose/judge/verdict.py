"""From what is named and what is left to a verdict, and how sure each name is.

Stands between the selection and the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.formats.model.drive import DriveLaw
from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.predict.floor import above_noise
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import DiagnosisVerdict
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.selection import Selection
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.simulate.servo import drive_torque, torque_per_unit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shares:
    """Errors as root mean squares of the mismatch, N*m, and the share of the explainable error that was removed."""

    before: float
    after: float
    floor: float
    removed: float

    @property
    def left(self) -> float:
        """What is left above the noise floor, N*m."""
        return math.sqrt(max(self.after**2 - self.floor**2, 0.0))


def shares(mismatch: tuple[Array, Array], counts: NDArray[np.bool_], floor: float) -> Shares:
    """Errors of two mismatches, before and after, over the rows that count; `floor` is a mean square."""
    before, after = (float(np.mean(rows[counts] ** 2)) for rows in mismatch)
    removed = (before - after) / above_noise(before, floor)
    return Shares(math.sqrt(before), math.sqrt(after), math.sqrt(floor), min(max(removed, 0.0), 1.0))


def without_event(predictor: Predictor, mismatch: Array) -> NDArray[np.bool_]:
    """The rows that count less those few stretches in which most of what is left stands: something happened there once.

    A verdict is about the axis. A push at the start or a broken stretch carries most of a mean square whatever the
    model; where they are not so few, or carry less than most of it, all rows are judged.
    """
    rows = max(1, round(SETTINGS.verdict.event_s / predictor.traces[0].period_s))
    kept, parts = predictor.counts.copy(), []
    for part in predictor.slices:
        parts += [slice(a, min(a + rows, part.stop)) for a in range(part.start, part.stop, rows)]
    power = np.array([float(np.sum(mismatch[part][predictor.counts[part]] ** 2)) for part in parts])
    few = max(1, math.ceil(SETTINGS.verdict.event_share * len(parts)))
    worst = np.argsort(-power)[:few]
    if len(parts) < SETTINGS.verdict.event_of or float(power[worst].sum()) < SETTINGS.verdict.event_power * power.sum():
        return kept
    for worst_part in worst:
        kept[parts[worst_part]] = False
    return kept if kept.any() else predictor.counts


#: Names that together remove less than this share of the explainable error explain next to nothing of it.
LEAST_REMOVED = 0.15


def verdict(named: Sequence[int], errors: Shares, dry: float, *, driven: bool = False) -> DiagnosisVerdict:
    """The verdict on what was named (places of terms) and what is left.

    Where the torque is `driven` (by the drive of the model, not recorded) what is left is the drive's as well.
    """
    left = errors.left / dry
    much = left > SETTINGS.verdict.left_torque and 1.0 - errors.removed > SETTINGS.verdict.left_share
    least = (
        SETTINGS.verdict.least_beside_much if left > SETTINGS.verdict.much_torque else SETTINGS.verdict.least_explained
    )
    least = SETTINGS.verdict.least_by_drive if driven else least
    if named and errors.removed < LEAST_REMOVED:
        return DiagnosisVerdict.UNEXPLAINED
    if much and (not named or errors.removed < least):
        return DiagnosisVerdict.UNEXPLAINED
    return DiagnosisVerdict.MISSING_PHYSICS if named else DiagnosisVerdict.ADEQUATE


def below_noise(found: DiagnosisVerdict, encoder_noise: float, dry: float) -> bool:
    """Whether a verdict without a name says nothing, because the encoder's noise is as large as what it is about."""
    hides = {
        DiagnosisVerdict.UNEXPLAINED: SETTINGS.verdict.hides_rest,
        DiagnosisVerdict.ADEQUATE: SETTINGS.verdict.hides_all,
    }
    return found in hides and encoder_noise > hides[found] * dry


def product_with(predictor: Predictor, model: AxisModel, name: str) -> str:
    """The effect of which and this one only the product shows, since a servo is hardly ever at its limit; else none."""
    law, other = model.drive, effect(name).product_with
    if law is None or not law.kind.feeds_back or not other:
        return ""
    rows = [_at_limit(model, law, trace) for trace in predictor.traces if trace.drive.told is not None]
    return other if rows and float(np.mean(np.concatenate(rows))) < SETTINGS.verdict.at_limit else ""


def _at_limit(model: AxisModel, law: DriveLaw, trace: CheckedTrace) -> NDArray[np.bool_]:
    """Rows in which the duty that a servo asks for is at its limit."""
    drive = trace.drive
    if drive.told is None or law.most is None:
        return np.zeros(len(drive.t_s), dtype=bool)
    made = drive_torque(law, drive.told, drive.t_s, drive.position, model.total_delay_s + law.delay_s)
    return np.asarray(np.abs(made) >= (1.0 - 1e-9) * law.most * torque_per_unit(law, drive.told))


def confidence(selection: Selection, index: int, removed: float) -> float:
    """Probability that the name of a term is right, from how far its best rival stayed behind.

    `removed` is the share of the explainable error that all names together remove: what they leave may be their fault.
    """
    own = len(selection.fit.hypothesis.terms[index].unknowns)
    gaps = [
        math.log(max(ratio, 1.0)) + SETTINGS.verdict.gap_scale * _more_unknowns(rival, own)
        for rival, ratio in _rivals(selection, index)
    ]
    sure = 0.5 + 0.49 * (1.0 - math.exp(-min(gaps, default=math.inf) / SETTINGS.verdict.gap_scale))
    return round(sure * min(1.0, removed / SETTINGS.verdict.fully), 3)


def _more_unknowns(rival: Candidate, own: int) -> int:
    """Unknowns that a rival needs beyond the finding's own: one that only does as well with more is no evidence."""
    return max(len(rival.term.unknowns) - own, 0)


def alternatives(selection: Selection, index: int) -> list[str]:
    """Effects that these data cannot tell apart from a term; its twin too where that is in beside it."""
    terms = selection.fit.hypothesis.terms
    twin = effect(terms[index].effect).twin
    beside = [term.effect for term in terms if term.effect == twin]
    return beside + [
        rival.effect
        for rival, ratio in _rivals(selection, index)
        if ratio <= SETTINGS.verdict.alike and rival.effect != twin
    ]


def _rivals(selection: Selection, index: int) -> list[tuple[Candidate, float]]:
    """Rivals of a term and what each left of the cost over what the term left, when the term came in.

    One that has the term within it leaves as little, and says nothing against it.
    """
    entry, within = selection.entries[index], effect(selection.fit.hypothesis.terms[index].effect).within
    return [(rival, rival.left / max(entry.left, 1e-12)) for rival in entry.rivals if rival.effect not in within]
