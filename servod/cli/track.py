"""`servoctl track`: run a reference motion on the enabled axis and wait for its end; Ctrl-C or SIGTERM stops it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, ask, connect, example, report
from servod.common.errors import AnswerIsNo, BadInput

if TYPE_CHECKING:
    from servod.client.control import ControlClient

#: Told how far a motion is: seconds since its start, and the status document's motion.
Tell = Callable[[float, dict[str, Any]], None]

#: The longest period that a configuration may have (servod.formats.config.CycleConfig).
LONGEST_PERIOD_US = 20_000
_POLL_S = 0.1
_app = typer.Typer(
    help=example("Run a reference motion from where the axis stands.", "servoctl track paper --duration 30"),
    rich_markup_mode=None,
)
_Wait = Annotated[
    bool, typer.Option("--wait/--no-wait", help="Wait for the end; Ctrl-C or SIGTERM then stops the axis.")
]
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
    _track(socket, motion, duration, wait, as_json)


@_app.command(
    short_help="Trajectory (19) of the paper.",
    help=example("Trajectory (19) of the paper, x = (0.1 - 0.0033 t) sin(0.2 pi t) rad.", "servoctl track paper"),
)
def paper(
    duration: _Duration = 30.0,
    wait: _Wait = True,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track trajectory (19)."""
    from servod.kernels.motions import PAPER_LONGEST_S

    if duration > PAPER_LONGEST_S:
        allowed = f"at most {PAPER_LONGEST_S:.6g} s, where the envelope of (19) ends"
        raise BadInput("--duration", f"{duration:g} s", allowed)
    _track(socket, {"kind": "paper", "duration_s": duration}, duration, wait, as_json)


@_app.command(help=example("A step of the reference.", "servoctl track step --amplitude 0.01 --duration 2"))
def step(
    amplitude: Annotated[float, typer.Option(help="Height in rad.")],
    duration: _Duration = 2.0,
    wait: _Wait = True,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track a step."""
    _track(socket, {"kind": "step", "amplitude_rad": amplitude, "duration_s": duration}, duration, wait, as_json)


@_app.command(
    short_help="Positions from a CSV file.",
    help=example(
        "Positions from a CSV file with the columns t_s and reference_rad, relative to where the axis stands.",
        "servoctl track csv motion.csv",
    ),
)
def csv(
    file: Annotated[Path, typer.Argument(help="CSV file with the columns t_s and reference_rad.")],
    period_us: Annotated[
        int | None, typer.Option(min=500, max=LONGEST_PERIOD_US, help="Period of the loop; the daemon knows it.")
    ] = None,
    wait: _Wait = True,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track positions from a file."""
    from servod.cli.motion_file import read_motion

    motion = read_motion(file)
    motion.on_grid((period_us or LONGEST_PERIOD_US) * 1e-6)  # what no daemon can take is refused without one
    if period_us is None:
        period_us = int(ask(socket, "status")["timing"]["period_us"])
    positions = motion.on_grid(period_us * 1e-6)
    duration_s = len(positions) * period_us * 1e-6
    _track(socket, {"kind": "csv", "positions_rad": positions}, duration_s, wait, as_json)


def _track(socket: Path, motion: dict[str, Any], duration_s: float, wait: bool, as_json: bool) -> None:
    with connect(socket) as client:
        if wait:
            with _progress(duration_s, as_json) as tell:
                result = _run(client, motion, tell)
        else:
            result = client.call("track", **motion)
    report(result, "motion done" if wait else "motion started", as_json)


def _run(client: ControlClient, motion: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Start the motion and wait for its end; whatever interrupts it stops the axis before it ends the command."""
    from servod.client.processes import sigterm_as_interrupt

    with sigterm_as_interrupt():
        try:
            result = client.call("track", **motion)
            _wait_until_over(client, tell)
        except KeyboardInterrupt:
            client.call("stop")
            raise
    return result


def _wait_until_over(client: ControlClient, tell: Tell) -> None:
    """Poll until the motion is over."""
    started = time.monotonic()
    while True:
        time.sleep(_POLL_S)
        status = client.call("status")
        if status["axis"]["state"] != "ENABLED":
            raise AnswerIsNo(f"the motion ended with the axis in {status['axis']['state']}: {_why(status)}")
        if not status["axis"]["motion_running"]:
            return
        tell(time.monotonic() - started, status["motion"])


@contextmanager
def _progress(duration_s: float, quiet: bool) -> Iterator[Tell]:
    """A bar on a terminal's standard error: time, reference and error; nothing elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    columns = (BarColumn(), TextColumn("{task.completed:.1f} of {task.total:.1f} s  {task.description}"))
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("", total=duration_s)

        def tell(elapsed_s: float, motion: dict[str, Any]) -> None:
            bar.update(task, completed=min(elapsed_s, duration_s), description=_where(motion))

        yield tell


def _where(motion: dict[str, Any]) -> str:
    """Reference and error of the status document in words; either is None while it is not finite."""
    if motion["stale"]:
        return "no feedback of the joint"
    reference, error = motion["reference_rad"], motion["following_error_rad"]
    if reference is None or error is None:
        return ""
    return f"reference {reference:+.4f} rad, error {1e3 * error:+.3f} mrad"


def _why(status: dict[str, Any]) -> str:
    return " ".join(f"{f['code']}: {f['cause']}" for f in status["faults"]) or "it was stopped or disabled"
