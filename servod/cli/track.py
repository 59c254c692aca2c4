"""`servoctl track`: run a reference motion on the enabled axis and wait for its end; Ctrl-C stops it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, connect, example, report
from servod.errors import AnswerIsNo

if TYPE_CHECKING:
    from servod.control import ControlClient

_POLL_S = 0.1
_app = typer.Typer(
    help=example("Run a reference motion from where the axis stands.", "servoctl track paper --duration 30"),
    rich_markup_mode=None,
)
_Wait = Annotated[bool, typer.Option("--wait/--no-wait", help="Wait for the end; Ctrl-C then stops the axis.")]
_Duration = Annotated[float, typer.Option(min=0.001, help="Duration in s.")]


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.add_typer(_app, name="track")


@_app.command(help=example("A sine of position.", "servoctl track sine --amplitude 0.1 --frequency 0.5 --duration 10"))
def sine(
    amplitude: Annotated[float, typer.Option(help="Amplitude in rad.")],
    frequency: Annotated[float, typer.Option(help="Frequency in Hz.")],
    duration: _Duration,
    wait: _Wait = True,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track a sine."""
    motion = {"kind": "sine", "amplitude_rad": amplitude, "frequency_hz": frequency, "duration_s": duration}
    _track(socket, motion, wait, as_json)


@_app.command(
    help=example("Trajectory (19) of the paper, x = (0.1 - 0.0033 t) sin(0.2 pi t) rad.", "servoctl track paper")
)
def paper(
    duration: _Duration = 30.0,
    wait: _Wait = True,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track trajectory (19)."""
    _track(socket, {"kind": "paper", "duration_s": duration}, wait, as_json)


@_app.command(help=example("A step of the reference.", "servoctl track step --amplitude 0.01 --duration 2"))
def step(
    amplitude: Annotated[float, typer.Option(help="Height in rad.")],
    duration: _Duration = 2.0,
    wait: _Wait = True,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track a step."""
    _track(socket, {"kind": "step", "amplitude_rad": amplitude, "duration_s": duration}, wait, as_json)


@_app.command(
    help=example(
        "Positions from a CSV file with the columns t_s and reference_rad, relative to where the axis stands.",
        "servoctl track csv motion.csv",
    )
)
def csv(
    file: Annotated[Path, typer.Argument(help="CSV file with the columns t_s and reference_rad.")],
    period_us: Annotated[int, typer.Option(min=500, max=20_000, help="Period of the loop.")] = 1000,
    wait: _Wait = True,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track positions from a file."""
    from servod.cli.motion_file import read_motion

    positions = read_motion(file, period_us * 1e-6)
    _track(socket, {"kind": "csv", "positions_rad": positions}, wait, as_json)


def _track(socket: Path, motion: dict[str, Any], wait: bool, as_json: bool) -> None:
    with connect(socket) as client:
        result = client.call("track", **motion)
        if wait:
            _wait_for_end(client)
    report(result, "motion done" if wait else "motion started", as_json)


def _wait_for_end(client: ControlClient) -> None:
    """Poll until the motion is over; an interrupt stops the axis before it ends the command."""
    try:
        while True:
            time.sleep(_POLL_S)
            status = client.call("status")
            if status["axis"]["state"] != "ENABLED":
                raise AnswerIsNo(f"the motion ended with the axis in {status['axis']['state']}: {_why(status)}")
            if not status["axis"]["motion_running"]:
                return
    except KeyboardInterrupt:
        client.call("stop")
        raise


def _why(status: dict[str, Any]) -> str:
    return " ".join(f"{f['code']}: {f['cause']}" for f in status["faults"]) or "it was stopped or disabled"
