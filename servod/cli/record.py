"""`servoctl record`: start and stop a recording in the daemon, and export one to CSV or Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, ask, connect, example, report, suggest
from servod.common.errors import AnswerIsNo, BadInput

_app = typer.Typer(
    help=example("Record every cycle; export a recording.", "servoctl record start", "servoctl record stop"),
    rich_markup_mode=None,
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.add_typer(_app, name="record")


@_app.command(help=example("Start recording every cycle (MCAP).", "servoctl record start"))
def start(
    name: Annotated[
        str | None, typer.Option(help="File name in recorder.directory (.mcap); a new one by default.")
    ] = None,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Start a recording."""
    try:
        result = ask(socket, "record_start", path=name)
    except BadInput as error:
        if error.where != "record_start: path":
            raise
        raise BadInput("--name", error.found, error.allowed) from None
    report(result, f"recording to {result['path']}", as_json)


@_app.command(help=example("Stop recording; exit code 1 when there is none.", "servoctl record stop"))
def stop(socket: SocketOption = DEFAULT_SOCKET, as_json: JsonOption = False) -> None:
    """Stop the recording."""
    with connect(socket) as client:
        recorder = client.call("status")["recorder"]
        if not recorder["recording"]:
            raise AnswerIsNo(f"not recording. {recorder['failure']}")
        result = client.call("record_stop")
    suggest("plot", result["path"], why="error, torque, states and faults in pictures")
    lost = f"; {result['dropped']} more are in no file, the disk did not keep up" if result["dropped"] else ""
    report(result, f"recorded {result['records']} cycles to {result['path']}{lost}", as_json)


@_app.command(
    help=example(
        "Turn a recording into CSV or Parquet, by the suffix of --out.", "servoctl record export run.mcap --out run.csv"
    )
)
def export(
    file: Annotated[Path, typer.Argument(help="Recording (.mcap).")],
    out: Annotated[Path, typer.Option(help="File to write: .csv or .parquet.")],
    as_json: JsonOption = False,
) -> None:
    """Export a recording."""
    from servod.formats.recording.export import export_csv, export_parquet
    from servod.formats.recording.mcap_reader import read_recording

    writers = {".csv": export_csv, ".parquet": export_parquet}
    if out.suffix not in writers:
        raise BadInput(f"--out {out}", repr(out.suffix), " or ".join(writers))
    recording = read_recording(file)
    rows = writers[out.suffix](recording, out)
    cut = f"; {recording.damage}" if recording.damage else ""
    result = {"path": str(out), "rows": rows, "truncated": recording.truncated, "damage": recording.damage}
    suggest("plot", str(file), why="the recording in pictures")
    report(result, f"wrote {out}: {rows} cycles of {file}{cut}", as_json)
