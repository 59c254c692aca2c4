"""Arguments of the control verbs as models: every key checked, one line for the first mistake.

Between control server and verbs.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field, model_validator

from servod.common.errors import BadInput
from servod.common.yaml import Strict, validate
from servod.formats.protocol import PIECE_SAMPLES, RENEW_S, SampleKey, Verb
from servod.kernels.motions import PAPER_LONGEST_S
from servod.runtime.daemon.trajectory import MotionTable
from servod.runtime.loop.commands import ReferenceKind

_Duration = Annotated[float, Field(gt=0.0, le=86_400.0)]


class MotionKind(StrEnum):
    """Reference motions by the names of the command line."""

    SINE = "sine"
    PAPER = "paper"
    STEP = "step"
    CSV = "csv"
    EXCITE = "excite"


#: Samples that stand in the request itself; more come ahead, with the verb `trajectory`.
_Samples = Annotated[
    list[float], Field(min_length=1, max_length=PIECE_SAMPLES, description="one for each period of the loop")
]

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
    """`enable`; with `prove` the test of the wiring is repeated although it was passed."""

    reset_fault: bool = Field(False, description="reset latched faults and the drive's own first")
    prove: bool = Field(False, description="test the wiring again")


class HaltArgs(Strict):
    """`halt`: true holds the reference, false goes on."""

    on: bool = Field(True, description="hold, or go on")


class TrajectoryArgs(Strict):
    """`trajectory`: a piece of the samples of the motion that comes next; `start` 0 begins the column again."""

    key: SampleKey = Field(description="the argument of `track` that the samples are of")
    start: int = Field(ge=0, description="number of the first sample; pieces follow one another without a gap")
    samples: _Samples


class TrackArgs(Strict):
    """`track`: one motion, relative to the present reference; positions are one for each period of the loop.

    With `uploaded: true` the samples are those that came ahead. With `start_immediately: false` the motion is only
    checked against the limits.
    """

    kind: MotionKind = Field(description="which motion")
    amplitude_rad: float | None = Field(None, ge=-1e4, le=1e4, description="of sine and step")
    frequency_hz: float | None = Field(None, gt=0.0, le=500.0, description="of a sine")
    duration_s: _Duration | None = Field(None, description="of sine, paper and step")
    positions_rad: _Samples | None = Field(None, description="of csv and excite, relative to the first sample")
    torques_nm: _Samples | None = Field(None, description="of excite: torque that is added to the controller's")
    window_rad: float | None = Field(
        None, gt=0.0, le=1e4, description="of excite: a change of the distance from the reference that ends it"
    )
    uploaded: bool = Field(False, description="the samples came ahead, with the verb `trajectory`")
    start_immediately: bool = Field(True, description="false: only check the motion against the limits")
    renew_s: float | None = Field(
        RENEW_S,
        ge=0.1,
        le=60.0,
        description="the motion halts when this client has asked nothing for so long, or has left; none: it goes on",
    )

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> TrackArgs:
        ahead = tuple(SampleKey) if self.uploaded else ()
        missing = [key for key in _NEEDS[self.kind] if key not in ahead and getattr(self, key) is None]
        if missing:
            raise ValueError(f"track {self.kind} with {', '.join(missing)}")
        return self

    @property
    def has_table(self) -> bool:
        """The motion reads samples."""
        return self.kind in (MotionKind.CSV, MotionKind.EXCITE)

    def table(self, uploaded: MotionTable) -> MotionTable:
        """The motion's samples, or `uploaded` when they came ahead. Raises BadInput when they do not fit the kind."""
        if not self.has_table:
            return MotionTable()
        table = uploaded if self.uploaded else MotionTable(self.positions_rad, self.torques_nm)
        table.require(torques=self.kind is MotionKind.EXCITE)
        return table

    def reference(self, table: MotionTable) -> list[float]:
        """The arguments of Op.REFERENCE; the samples of `table` must stand in the trajectory area already.

        Raises BadInput for more of (19) than there is.
        """
        if self.kind is MotionKind.PAPER and (self.duration_s or 0.0) > PAPER_LONGEST_S:
            allowed = f"at most {PAPER_LONGEST_S:.6g} s, where the envelope of (19) ends"
            raise BadInput("track paper: duration_s", f"{self.duration_s:g} s", allowed)
        if not self.has_table:
            return [ReferenceKind[self.kind.name], *(float(getattr(self, key)) for key in _NEEDS[self.kind])]
        positions = table.positions
        extent = [len(positions.values), positions.lowest, positions.highest]
        if self.kind is MotionKind.CSV:
            return [ReferenceKind.TABLE, *extent]
        return [ReferenceKind.EXCITE, *extent, self.window_rad or 0.0]


class GainsLoadArgs(Strict):
    """`gains_load`: the YAML text of a gain set; `name` says in errors which one."""

    name: str = Field(min_length=1, max_length=200, description="what errors call it, e.g. the file's name")
    text: str = Field(description="the gain set as YAML")


class GainsActivateArgs(Strict):
    """`gains_activate`: a stored set, its newest version unless given.

    With `trial` it runs only until its client says `gains_keep`; else, or when that client leaves, the set that was
    active before runs again.
    """

    name: str = Field(min_length=1, max_length=200, description="name in the store")
    version: int | None = Field(None, ge=1, description="none: the newest")
    trial: bool = Field(False, description="only until it is kept")


class GainsVerdictArgs(Strict):
    """`gains_keep` and `gains_rollback`: what was measured and why, for the history of the store.

    A `gains_rollback` with `trial` ends a trial and does nothing else.
    """

    note: str = Field("", max_length=4000, description="why")
    figures: dict[str, float] = Field(default_factory=dict, max_length=64, description="what was measured, by name")
    trial: bool = Field(False, description="of `gains_rollback`: end a trial and do nothing else")


class RecordStartArgs(Strict):
    """`record_start`: a file in the recordings' directory, or a new name."""

    path: str | None = Field(None, min_length=1, max_length=4096, description="file name; none: a new one")


class CyclesArgs(Strict):
    """`cycles`: the records after the one with this serial number; without it the number alone of the newest."""

    after: int | None = Field(None, ge=0, description="serial number of the last record that is known")


_MODELS: dict[Verb, type[Strict]] = {
    Verb.ENABLE: EnableArgs,
    Verb.HALT: HaltArgs,
    Verb.TRAJECTORY: TrajectoryArgs,
    Verb.TRACK: TrackArgs,
    Verb.GAINS_LOAD: GainsLoadArgs,
    Verb.GAINS_ACTIVATE: GainsActivateArgs,
    Verb.GAINS_KEEP: GainsVerdictArgs,
    Verb.GAINS_ROLLBACK: GainsVerdictArgs,
    Verb.RECORD_START: RecordStartArgs,
    Verb.CYCLES: CyclesArgs,
}


def arguments_of(verb: Verb) -> type[Strict]:
    """The model of a verb's arguments."""
    return _MODELS.get(verb, NoArgs)


def check_arguments(verb: Verb, args: dict[str, Any]) -> Any:
    """The verb's arguments as its model. Raises BadInput naming verb and key."""
    return validate(args, arguments_of(verb), verb)
