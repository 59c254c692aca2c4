"""Writes an axis model for another engine and says what that costs: the room's entry, used by `servoctl export`.

A format is one row of FORMATS: what it leaves out, what it says, how it is written, and who runs it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from servod import __version__
from servod.common.files import write_bytes
from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.lab.export import judge, mjcf, urdf
from servod.lab.export.reduce import LostEffect
from servod.lab.simulate.replay import Drive

#: What the file's joint is called where nobody says otherwise.
JOINT = "axis"


class Format(NamedTuple):
    """A language: what it has no words for, the model as it says it, the text of a file, whether MuJoCo reads it."""

    losses: tuple[LostEffect, ...]
    says: Callable[[AxisModel], AxisModel]
    write: Callable[[AxisModel, str], str]
    for_engine: bool


def _json(model: AxisModel, name: str) -> str:
    """The whole model as one JSON document: the keys of the axis model file, and the units that they are in."""
    units = ("m", "N") if model.axis is AxisKind.LINEAR else ("rad", "N*m")
    plain = model.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    document = {"axis_model": plain, "name": name, "units": {"position": units[0], "torque": units[1], "time": "s"}}
    return json.dumps(document | {"written_by": f"servod {__version__}"}, indent=1, allow_nan=False) + "\n"


FORMATS: dict[str, Format] = {
    "mujoco": Format(mjcf.LOSSES, mjcf.says, mjcf.write, True),
    "urdf": Format(urdf.LOSSES, urdf.says, urdf.write, True),
    "json": Format((), lambda model: model, _json, False),
}


@dataclass(frozen=True)
class Exported:
    """A written file and what is known of it.

    `round_trip`: None where no engine could be asked, and then `not_run` says why. `not_expressed`: lost effect ->
    window error that it causes by itself, RMS in `unit`. `judged_on`: recordings; empty for the model's own motion.
    """

    file: Path
    format: str
    joint: str
    unit: str
    horizon_s: float
    round_trip: judge.RoundTrip | None
    not_run: str
    not_expressed: dict[str, float]
    judged_on: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """The JSON document of `servoctl export`."""
        return {
            "file": str(self.file),
            "format": self.format,
            "joint": self.joint,
            "unit": self.unit,
            "horizon_s": self.horizon_s,
            "round_trip": self.round_trip.document() if self.round_trip else None,
            "not_run": self.not_run,
            "not_expressed": self.not_expressed,
            "judged_on": list(self.judged_on),
        }


def export(model: AxisModel, kind: str, out: Path, joint: str, recorded: Sequence[tuple[str, Drive]]) -> Exported:
    """Write `model` in the format `kind` (a key of FORMATS) to `out`, and judge the file on the recordings given.

    Without recordings the model's own motion is the judge. Raises BadInput (the file cannot be written, the engine
    refuses it).
    """
    chosen = FORMATS[kind]
    said = chosen.says(model)
    text = chosen.write(said, joint)
    drives = [drive for _, drive in recorded] or [judge.own_motion(model)]
    lost = judge.costs(model, chosen.losses, drives)
    trip, not_run = _round_trip(chosen, said, text, joint, drives)
    write_bytes(out, text.encode())
    unit = "m" if model.axis is AxisKind.LINEAR else "rad"
    names = tuple(name for name, _ in recorded)
    return Exported(out, kind, joint, unit, judge.HORIZON_S, trip, not_run, lost, names)


def _round_trip(
    chosen: Format, said: AxisModel, text: str, joint: str, drives: Sequence[Drive]
) -> tuple[judge.RoundTrip | None, str]:
    """The file in the engine, or as our own reader understands it; None and the reason where there is no engine."""
    if not chosen.for_engine:
        read = AxisModel.model_validate(json.loads(text)["axis_model"])
        return judge.reread(said, read, drives), ""
    try:
        return judge.round_trip(said, text, joint, drives), ""
    except ImportError:
        return None, "MuJoCo is not installed: pip install 'servod[sim]' runs the file beside the model"
