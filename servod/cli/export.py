"""`servoctl export`: the axis model as MJCF, URDF or JSON, with what that format cannot say and what it costs.

Works on files alone; needs the lab extra, and MuJoCo (extra sim) to run what was written.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servod.cli.common import JsonOption, example, keep_inputs, print_json
from servod.cli.groups import export_formats
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.files import BadFile
from servod.common.units import counted

if TYPE_CHECKING:
    from servod.lab.export.export import Exported

EXAMPLE = "servoctl export --model model.yaml --format mujoco --out axis.xml"


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="export", help=example("Write an axis model for another simulator.", EXAMPLE))(export)


def export(
    model: Annotated[Path, typer.Option(help="Axis model (YAML).")],
    out: Annotated[Path, typer.Option(help="Write here.")],
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="[REC]...", help="Recordings to judge on; none: a motion of its own.")
    ] = None,
    format_: Annotated[
        str, typer.Option("--format", help="mujoco (MJCF), urdf or json.", autocompletion=export_formats)
    ] = "mujoco",
    joint: Annotated[str, typer.Option(help="Name of the joint in the file.")] = "axis",
    map_file: Annotated[
        Path | None, typer.Option("--map", help="Names and units of foreign columns: YAML, or a shipped map.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write MODEL for another engine, run what was written, and say what the format leaves out."""
    if format_ not in export_formats():
        raise BadInput("--format", repr(format_), ", ".join(export_formats()))
    if not joint.isidentifier():
        raise BadInput("--joint", repr(joint), "letters, digits and underscores")
    if not out.resolve().parent.is_dir():
        raise BadFile(f"--out {out}", "there is no such folder to write it in", "a file in a folder that exists")
    keep_inputs(out, model, map_file, *(recordings or ()))
    if map_file is not None and not recordings:
        raise BadInput(f"--map {map_file}", "no recording beside it", "--map with recordings whose columns it names")
    from servod.formats.model.axis_model import load_axis_model
    from servod.lab.export.export import export as write
    from servod.lab.recordings import load_recording

    axis = load_axis_model(model)
    drives = []
    for path in recordings or []:
        recorded = load_recording(path, map_file)
        if recorded.axis is not axis.axis:
            raise BadInput(f"{model}: axis", axis.axis.value, f"{recorded.axis.value}, as the columns of {path} say")
        drives.append((str(path), recorded.drive))
    done = write(axis, format_, out, joint, drives)
    if as_json:
        print_json(done.document())
    else:
        _print(done)
    if done.round_trip is not None and not done.round_trip.agrees:
        raise AnswerIsNo(f"{out}: {done.round_trip.engine} does not move the joint as servod does")


def _print(done: Exported) -> None:
    unit, trip = done.unit, done.round_trip
    judged = counted(len(done.judged_on), "recording") if done.judged_on else "a motion of the model"
    print(f"{done.file}: joint {done.joint}, as {done.format}")
    print(f"judged on {judged}, in windows of {done.horizon_s:g} s")
    if trip is None:
        print(f"round trip: {done.not_run}")
    else:
        errors = f"error {1e3 * trip.theirs:.4g} m{unit} RMS, ours {1e3 * trip.ours:.4g}"
        verdict = "agrees" if trip.agrees else "does not agree"
        print(f"round trip: {verdict}; {trip.engine}: {errors}; {trip.apart:.2%} of the way apart")
    if not done.not_expressed:
        print("not expressed: nothing")
    for name, cost in sorted(done.not_expressed.items(), key=lambda pair: -pair[1]):
        print(f"not expressed: {name}, which costs {1e3 * cost:.4g} m{unit} RMS")
