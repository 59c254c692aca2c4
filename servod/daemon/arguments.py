"""Arguments of the control verbs as models: every key checked, one line for the first mistake.

Between control server and verbs.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field, model_validator

from servod.commands import ReferenceKind
from servod.control import Verb
from servod.loop.channel import TRAJECTORY_SAMPLES
from servod.yaml12 import Strict, validate

_Duration = Annotated[float, Field(gt=0.0, le=86_400.0)]


class MotionKind(StrEnum):
    """Reference motions by the names of the command line."""

    SINE = "sine"
    PAPER = "paper"
    STEP = "step"
    CSV = "csv"
    EXCITE = "excite"


_NEEDS: dict[MotionKind, tuple[str, ...]] = {
    MotionKind.SINE: ("amplitude_rad", "frequency_hz", "duration_s"),
    MotionKind.PAPER: ("duration_s",),
    MotionKind.STEP: ("amplitude_rad", "duration_s"),
    MotionKind.CSV: ("positions_rad",),
    MotionKind.EXCITE: ("positions_rad", "torques_nm", "window_rad"),
}


class NoArgs(Strict):
    """Verbs without arguments."""


class EnableArgs(Strict):
    """`enable`."""

    reset_fault: bool = False


class HaltArgs(Strict):
    """`halt`: true holds the reference, false goes on."""

    on: bool = True


class TrackArgs(Strict):
    """`track`: one motion, relative to the present reference; positions are one for each period of the loop.

    With `start_immediately: false` the motion is only checked against the limits' range.
    """

    kind: MotionKind
    amplitude_rad: float | None = Field(None, ge=-1e4, le=1e4)
    frequency_hz: float | None = Field(None, gt=0.0, le=500.0)
    duration_s: _Duration | None = None
    positions_rad: list[float] | None = Field(None, min_length=2, max_length=TRAJECTORY_SAMPLES)
    torques_nm: list[float] | None = Field(None, min_length=2, max_length=TRAJECTORY_SAMPLES // 2)
    window_rad: float | None = Field(None, gt=0.0, le=1e4)
    start_immediately: bool = True

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> TrackArgs:
        missing = [key for key in _NEEDS[self.kind] if getattr(self, key) is None]
        if missing:
            raise ValueError(f"track {self.kind} with {', '.join(missing)}")
        if self.kind is MotionKind.EXCITE and len(self.positions_rad or []) != len(self.torques_nm or []):
            raise ValueError("track excite with as many torques_nm as positions_rad")
        return self

    def area(self) -> list[float]:
        """What the motion reads from the trajectory area: positions, and behind them the torques of an excitation."""
        return [*(self.positions_rad or []), *(self.torques_nm or [])]

    def reference(self) -> list[float]:
        """The arguments of Op.REFERENCE; what `area` gives must stand in the trajectory area already."""
        if self.kind is MotionKind.CSV:
            positions = self.positions_rad or []
            return [ReferenceKind.TABLE, len(positions), min(positions), max(positions)]
        if self.kind is MotionKind.EXCITE:
            positions = self.positions_rad or []
            window_rad = self.window_rad or 0.0
            return [ReferenceKind.EXCITE, len(positions), min(positions), max(positions), window_rad]
        kind = ReferenceKind[self.kind.name]
        return [kind, *(float(getattr(self, key)) for key in _NEEDS[self.kind])]


class GainsLoadArgs(Strict):
    """`gains_load`: the YAML text of a gain set; `name` says in errors which one."""

    name: str = Field(min_length=1, max_length=200)
    text: str = Field(max_length=1_000_000)


class GainsActivateArgs(Strict):
    """`gains_activate`: a stored set, its newest version unless given."""

    name: str = Field(min_length=1, max_length=200)
    version: int | None = Field(None, ge=1)


class RecordStartArgs(Strict):
    """`record_start`: a file in the recordings' directory, or a new name."""

    path: str | None = Field(None, min_length=1, max_length=4096)


_MODELS: dict[Verb, type[Strict]] = {
    Verb.ENABLE: EnableArgs,
    Verb.HALT: HaltArgs,
    Verb.TRACK: TrackArgs,
    Verb.GAINS_LOAD: GainsLoadArgs,
    Verb.GAINS_ACTIVATE: GainsActivateArgs,
    Verb.RECORD_START: RecordStartArgs,
}


def check_arguments(verb: Verb, args: dict[str, Any]) -> Any:
    """The verb's arguments as its model. Raises BadInput naming verb and key."""
    return validate(args, _MODELS.get(verb, NoArgs), verb)
