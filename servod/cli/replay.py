"""`servoctl replay`: simulate an axis model under a recorded torque and say how far it is off.

Works on files alone; needs the lab extra (numpy, scipy; numba makes it fast).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, keep_inputs, print_json
from servod.cli.groups import horizons, starts
from servod.common.errors import BadInput
from servod.common.files import BadFile

if TYPE_CHECKING:
    from servod.formats.model.axis_model import AxisModel
    from servod.lab.recordings import Recording
    from servod.lab.simulate.motion import Start
    from servod.lab.simulate.replay import Drive, Replay

EXAMPLE = "servoctl replay --model model.yaml run.csv.gz --horizon 0.25 --out sim.csv"


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="replay", help=example("Simulate a model under a recorded torque.", EXAMPLE))(replay)


def replay(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="CSV, text, Parquet, MAT v5, npy, JSON or MCAP.")],
    model: Annotated[Path, typer.Option(help="Axis model (YAML).")],
    horizon: Annotated[
        str, typer.Option(help="Restart from the recording every so many seconds, or `full`.", autocompletion=horizons)
    ] = "full",
    map_file: Annotated[
        Path | None, typer.Option("--map", help="Names and units of foreign columns: YAML, or a shipped map.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write t_s, position and velocity here (.csv or .parquet).")] = None,
    start: Annotated[
        str,
        typer.Option(
            help="First row: rest, recorded, or auto (at rest where it stands; just set off: free runs).",
            autocompletion=starts,
        ),
    ] = "auto",
    from_s: Annotated[float | None, typer.Option(help="First time of REC to use, s.")] = None,
    to_s: Annotated[float | None, typer.Option(help="Time of REC to stop before, s.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate MODEL under the torque of REC and report the position error.

    Where REC has no torque the drive of MODEL makes it; a servo's loop is closed over the simulated position.
    """
    horizon_s = parse_horizon(horizon)
    check_out(out)
    if out is not None:
        keep_inputs(out, recording, model, map_file)
    first = parse_start(start)
    from servod.formats.model.axis_model import load_axis_model
    from servod.lab.recordings import load_recording
    from servod.lab.simulate.replay import replay as simulate
    from servod.lab.simulate.replay import switched_on

    axis = load_axis_model(model)
    recorded = load_recording(recording, map_file).between(from_s, to_s)
    if recorded.axis is not axis.axis:
        raise BadInput(f"{model}: axis", axis.axis.value, f"{recorded.axis.value}, as the columns of {recording} say")
    drive = switched_on(axis, recorded.driven_by(axis))
    result = simulate(axis, drive, horizon_s, start=first)
    if out is not None:
        write_simulation(out, recorded, result)
    document = summary(recorded, axis, result, horizon_s, drive)
    if as_json:
        print_json(document)
    else:
        print_summary(document)


def parse_horizon(text: str) -> float | None:
    """Seconds between restarts, None for `full`. Raises BadInput."""
    if text == "full":
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 1e-3 <= seconds < 1e6:
        raise BadInput("--horizon", repr(text), "seconds from 0.001 up, or full")
    return seconds


def parse_start(text: str) -> Start:
    """What the first row is taken for. Raises BadInput."""
    from servod.lab.simulate.motion import Start

    if text not in set(Start):
        raise BadInput("--start", repr(text), ", ".join(Start))
    return Start(text)


def check_out(out: Path | None) -> None:
    """Raise BadInput when nothing could be written to `out`."""
    if out is None:
        return
    if out.suffix not in {".csv", ".parquet"}:
        raise BadInput(f"--out {out}", repr(out.suffix), ".csv or .parquet")
    if not out.resolve().parent.is_dir():
        raise BadFile(f"--out {out}", "there is no such folder to write it in", "a file in a folder that exists")


def write_simulation(out: Path, recorded: Recording, result: Replay) -> None:
    """Write the simulated motion, one row for each recorded row, on the recording's own time stamps."""
    from servod.formats.recording.export import write_table
    from servod.lab.recordings import Quantity

    axis = recorded.axis
    write_table(
        out,
        {
            Quantity.TIME.column(axis): recorded.t_s,
            Quantity.POSITION.column(axis): result.position,
            Quantity.VELOCITY.column(axis): result.velocity,
        },
    )


def summary(
    recorded: Recording, axis: AxisModel, result: Replay, horizon_s: float | None, drive: Drive
) -> dict[str, Any]:
    """The command's JSON document: the error over rows whose position was measured, and what it was measured on."""
    unit = "m" if axis.axis.value == "linear" else "rad"
    measured = result.over(recorded.measured)
    return {
        "recording": str(recorded.path),
        "rows": len(recorded),
        "duration_s": float(recorded.t_s[-1] - recorded.t_s[0]),
        "horizon_s": "full" if horizon_s is None else horizon_s,
        "windows": len(result.starts),
        "unit": unit,
        f"rms_error_{unit}": measured.rms,
        f"max_error_{unit}": measured.max,
        f"mean_error_{unit}": measured.mean,
        "start": "rest" if result.at_rest else "recorded",
        "report": [
            *recorded.report,
            *horizon_report(recorded, horizon_s),
            *gap_report(recorded, horizon_s),
            *drive_report(axis, drive),
        ],
    }


def drive_report(axis: AxisModel, drive: Drive) -> list[str]:
    """What was made of the command where it is no torque, in sentences."""
    if axis.drive is None or drive.told is None:
        return []
    sentence = f"torque: by the model's drive ({axis.drive.kind.value})"
    if axis.drive.kind.feeds_back:
        sentence += ", its loop closed over the simulated motion"
    off = ~drive.told.on
    if not off.any():
        return [sentence]
    return [
        sentence,
        f"drive: off in {100.0 * float(off.mean()):.0f} % of the rows, from {drive.t_s[off.argmax()]:.4g} s",
    ]


def horizon_report(recorded: Recording, horizon_s: float | None) -> list[str]:
    """A horizon that no restart comes from, in a sentence."""
    length_s = float(recorded.t_s[-1] - recorded.t_s[0])
    if horizon_s is None or horizon_s <= length_s:
        return []
    return [f"--horizon: {horizon_s:g} s is longer than the {length_s:.4g} s of the recording; no restart"]


def gap_report(recorded: Recording, horizon_s: float | None) -> list[str]:
    """What the replay did at long gaps, in a sentence."""
    from servod.lab.simulate.replay import RESTART_GAP_S, behind_gaps

    gaps = len(behind_gaps(recorded.t_s))
    if gaps == 0:
        return []
    did = "run through, the last command held" if horizon_s is None else "restarted from the recording behind each"
    return [f"gaps longer than {1e3 * RESTART_GAP_S:.0f} ms and than ten samples: {gaps}; {did}"]


def print_summary(document: dict[str, Any]) -> None:
    """Print the summary for people; large and small errors in milli-units."""
    unit = document["unit"]
    for line in document["report"]:
        print(f"note: {line}")
    windows = document["windows"]
    span = "one free run" if windows == 1 else f"{windows} windows"
    print(f"{document['recording']}: {document['rows']} rows, {document['duration_s']:.3f} s, {span}")
    print("start: " + ("at rest" if document["start"] == "rest" else "in motion, as recorded"))
    rms, largest = (1e3 * document[f"{kind}_error_{unit}"] for kind in ("rms", "max"))
    print(f"open-loop position error: RMS {rms:.4g} m{unit}, max {largest:.4g} m{unit}")
