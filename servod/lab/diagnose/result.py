"""What a diagnosis found, finished: plain numbers, names and curves.

The engine fills it, and it is complete when `diagnose` returns; document, page and model file format it and compute
nothing. Torques are in N*m (N on a linear axis), positions in rad (m), errors root mean squares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


class DiagnosisVerdict(StrEnum):
    """The outside contract's verdicts, and one for data that can tell nothing."""

    ADEQUATE = "adequate"
    MISSING_PHYSICS = "missing_physics"
    UNEXPLAINED = "unexplained"
    CANNOT_TELL = "cannot_tell"


class MinorReason(StrEnum):
    """Why a term that stays in the model is no finding."""

    LEVEL = "below the level from which its effect counts"
    TWIN = "told together with its longer twin"
    SMALL = "below the smallest size worth a name"
    UNSURE = "not told from none"
    AT_END = "a number of it lies at the end of its range"
    BEYOND = "more torque than the recordings hold"


@dataclass(frozen=True)
class Units:
    """Units of position and torque of an axis; others are made of them."""

    length: str
    force: str


@dataclass(frozen=True)
class RefusedRecording:
    """A recording that cannot tell, and why; `notes` as of one that can."""

    name: str
    reason: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class FittedValue:
    """An estimate with its 95 % interval; `nominal` is the model's own value before, where there was one."""

    value: float
    unit: str
    low: float
    high: float
    nominal: float | None = None


@dataclass(frozen=True)
class MismatchMap:
    """Mean of the mismatch over one coordinate, in bins with rows enough: their middles, means and standard errors.

    `share` is the part of the mismatch's power over all rows that the means carry beyond chance, `chance` the
    probability that noise makes them; `bins` counts those with too few rows as well.
    """

    coordinate: str
    unit: str
    at: Array
    mean: Array
    error: Array
    bins: int
    share: float
    chance: float

    @property
    def seen(self) -> bool:
        """Whether it is more than noise makes."""
        return self.chance < SETTINGS.maps.seen


@dataclass(frozen=True)
class ResidualTable:
    """What fits no known physics: a resisting torque over one coordinate, and the share it takes of unseen rows."""

    coordinate: str
    grid: Array
    torque: Array
    share: float


@dataclass(frozen=True)
class SignaturePart:
    """Rows of one direction, or of one sign of the command: bins over the coordinate; no bins where rows are too few.

    `left` is the mean error without the term, `half` twice its standard error, `term` what the term makes of it.
    """

    rows: str
    at: Array
    left: Array
    half: Array
    term: Array


@dataclass(frozen=True)
class Signature:
    """One term over the coordinate where its effect shows, and over the stretch of time in which it acts most.

    `number` counts the terms of the fit from 1. With a `period` the coordinate is taken modulo that.
    """

    number: int
    coordinate: str
    unit: str
    period: float | None
    parts: tuple[SignaturePart, ...]
    recording: str
    t_s: Array
    without: Array
    term: Array
    left: Array


@dataclass(frozen=True)
class NamedEffect:
    """One effect that is named, with all its terms.

    `removed_share` is the part of the explainable error that it removes on unseen rows, `torque` its size as a share of
    dry friction where it acts. `without` and `after` are the errors on unseen rows without and with it. `alternatives`
    are effects that these data cannot tell it from; `located` says where it acts, by recording, time and coordinate. Of
    it and `product_with` only the product shows, where that is an effect.
    """

    effect: str
    forms: tuple[str, ...]
    parameters: Mapping[str, FittedValue]
    confidence: float
    alternatives: tuple[str, ...]
    located: Mapping[str, Any]
    removed_share: float
    torque: float
    without: float
    after: float
    signatures: tuple[Signature, ...]
    product_with: str = ""


@dataclass(frozen=True)
class Minor:
    """An effect that is there and no finding: its torque as a share of dry friction, its share of the error.

    One that stands in the model has its parameters too, and why it is no finding.
    """

    torque: float
    share: float
    why: MinorReason | None = None
    parameters: Mapping[str, FittedValue] | None = None


@dataclass(frozen=True)
class PartialEffect:
    """An effect that removes `share` of the explainable error on unseen rows, beside something that has no name."""

    effect: str
    share: float
    parameters: Mapping[str, FittedValue]


@dataclass(frozen=True)
class PartialAnswer:
    """What known physics explains of a mismatch that it does not explain: no finding, for what is left may change it.

    `share` is what all of it removes together, `rest` the coordinate over which what is left shows most.
    """

    effects: tuple[PartialEffect, ...]
    share: float
    rest: str


@dataclass(frozen=True)
class FreeRun:
    """Position errors of windows simulated freely: by the model as it came, recalibrated, and with the physics added.

    The last two were fitted without the rows that they are judged by.
    """

    before: float
    recalibrated: float
    after: float


@dataclass(frozen=True)
class Windows:
    """Errors of all windows of one length, of those in each recording, and row by row in the worst recording."""

    horizon_s: float
    errors: FreeRun
    recordings: Mapping[str, FreeRun]
    worst: str
    t_s: Array
    before: Array
    after: Array


@dataclass(frozen=True)
class RecordingErrors:
    """One recording: what was repaired, its noise, and its mismatch by fits that have not seen the rows.

    The curves are root mean squares over short stretches of time, from `t_s` on each.
    """

    name: str
    duration_s: float
    rows: int
    period_s: float
    position_noise: float
    notes: tuple[str, ...]
    noise_floor: float
    before: float
    after: float
    t_s: Array
    before_curve: Array
    after_curve: Array


@dataclass(frozen=True)
class Spectrum:
    """Amplitude of the mismatch by frequency, per root of Hz."""

    frequency_hz: Array
    amplitude: Array


@dataclass(frozen=True)
class Quality:
    """Errors of the fit on rows that it has not seen, before and after, and what they are compared with.

    `removed` is the share of the explainable error that the names remove, `removed_by_known` what known physics does,
    also where its names may not stand. `left_out` says what was left out in turn; for `not_judged_s` only an event
    stands in the recordings, which nothing predicts.
    """

    before: float
    after: float
    noise_floor: float
    removed: float
    removed_by_known: float
    left_out: str
    not_judged_s: float
    windows: tuple[Windows, ...]
    spectrum_before: Spectrum
    spectrum_after: Spectrum


@dataclass(frozen=True)
class SearchEffort:
    """How it was searched: the observer's bandwidth, starts of effects tried, whether time ended the search."""

    observer_rad_s: float
    starts_tried: int
    cut_by_time: bool


@dataclass(frozen=True)
class Evidence:
    """Everything behind a verdict on recordings that can tell.

    `model` is the axis model with the physics added; where nothing has a name, whichever predicts unseen rows best.
    `drive` is what was unknown of the drive. `maps_before` and `bands` (of frequency) show the mismatch of the
    recalibrated model, `maps_after` what is left.
    `partial` is what known physics explains of something that has no name. `encoder_noise` is what the encoder alone
    makes of torque in a row.
    """

    findings: tuple[NamedEffect, ...]
    recalibrated: Mapping[str, FittedValue]
    drive: Mapping[str, FittedValue]
    minor: Mapping[str, Minor]
    residual: ResidualTable | None
    model: AxisModel
    quality: Quality
    maps_before: tuple[MismatchMap, ...]
    maps_after: tuple[MismatchMap, ...]
    bands: Mapping[str, Any]
    recordings: tuple[RecordingErrors, ...]
    search: SearchEffort
    encoder_noise: float
    dry_friction: float
    partial: PartialAnswer | None = None


@dataclass(frozen=True)
class HeldOutWindow:
    """RMS position errors of windows of one length: by the model as it came, by the extended one, and by coasting."""

    horizon_s: float
    before: float
    after: float
    coasting: float


@dataclass(frozen=True)
class HeldOutRecording:
    """A recording that nothing was fitted to."""

    name: str
    windows: tuple[HeldOutWindow, ...]


@dataclass(frozen=True)
class Diagnosis:
    """What was found; without any recording that can tell there is no evidence. `seconds` is the time by stage."""

    units: Units
    refused: tuple[RefusedRecording, ...]
    verdict: DiagnosisVerdict
    evidence: Evidence | None
    seconds: Mapping[str, float]
    held_out: tuple[HeldOutRecording, ...] = ()
