"""`servoctl track`: run a reference motion on the enabled axis, wait for its end, and say how well it was followed.

Ctrl-C or SIGTERM stops the axis. The figures are made of the daemon's cycle records as they come; numpy is wanted for a
picture alone.
"""

from __future__ import annotations

import math
import sys
import time
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from csv import DictReader
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from servod.cli.common import (
    DEFAULT_SOCKET,
    JsonOption,
    SocketOption,
    ask,
    connect,
    example,
    print_json,
    report,
    suggest,
)
from servod.common.errors import AnswerIsNo, BadInput, ServodError
from servod.formats.recording.record import RECORD, CycleRecord

if TYPE_CHECKING:
    from servod.client.control import ControlClient

#: Told how far a motion is: seconds since its start, and the status document's motion.
OnProgress = Callable[[float, dict[str, Any]], None]

#: The longest period that a configuration may have (servod.formats.config_wire.CycleConfig).
LONGEST_PERIOD_US = 20_000
_POLL_S = 0.1
#: After its end the axis is watched for so long, until the reference has stood still for this time.
_WATCH_S = 0.5
#: Cycles of a longer motion would fill the memory; a recording holds them.
_LONGEST_PLOT_S = 600.0
#: Somebody may halt a motion for as long as he likes: what comes beyond this is not drawn.
_MOST_KEPT_BYTES = 512 * 1024**2
#: How the figures of a motion begin that ran to its end.
_DONE = "motion done"
#: And of one that did not.
_BROKEN_OFF = "motion broken off"
_INTERRUPTED = "stopped by Ctrl-C or SIGTERM: the axis is brought to rest and disabled"
_app = typer.Typer(
    help=example("Run a reference motion from where the axis stands.", "servoctl track paper --duration 30"),
    rich_markup_mode=None,
)
_Wait = Annotated[
    bool,
    typer.Option(
        "--wait/--no-wait",
        help="Wait for the end: Ctrl-C or SIGTERM stops the axis; a command that dies or hangs halts it within 0.5 s. "
        "With --no-wait the motion goes on by itself.",
    ),
]
_Plot = Annotated[
    Path | None, typer.Option("--plot", help="Draw the motion into this file: .html or .png (extra lab).")
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
    plot: _Plot = None,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track a sine."""
    motion = {"kind": "sine", "amplitude_rad": amplitude, "frequency_hz": frequency, "duration_s": duration}
    _track(socket, motion, duration, wait, plot, as_json)


@_app.command(
    short_help="Trajectory (19) of the paper.",
    help=example("Trajectory (19) of the paper, x = (0.1 - 0.0033 t) sin(0.2 pi t) rad.", "servoctl track paper"),
)
def paper(
    duration: _Duration = 30.0,
    wait: _Wait = True,
    plot: _Plot = None,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track trajectory (19)."""
    from servod.kernels.motions import PAPER_LONGEST_S

    if duration > PAPER_LONGEST_S:
        allowed = f"at most {PAPER_LONGEST_S:.6g} s, where the envelope of (19) ends"
        raise BadInput("--duration", f"{duration:g} s", allowed)
    _track(socket, {"kind": "paper", "duration_s": duration}, duration, wait, plot, as_json)


@_app.command(help=example("A step of the reference.", "servoctl track step --amplitude 0.01 --duration 2"))
def step(
    amplitude: Annotated[float, typer.Option(help="Height in rad.")],
    duration: _Duration = 2.0,
    wait: _Wait = True,
    plot: _Plot = None,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track a step."""
    _track(socket, {"kind": "step", "amplitude_rad": amplitude, "duration_s": duration}, duration, wait, plot, as_json)


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
    plot: _Plot = None,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Track positions from a file."""
    motion = read_motion(file)
    motion.on_grid((period_us or LONGEST_PERIOD_US) * 1e-6)  # what no daemon can take is refused without one
    if period_us is None:
        period_us = int(ask(socket, "status")["timing"]["period_us"])
    positions = motion.on_grid(period_us * 1e-6)
    duration_s = len(positions) * period_us * 1e-6
    _track(socket, {"kind": "csv", "positions_rad": positions}, duration_s, wait, plot, as_json)


def _track(
    socket: Path, motion: dict[str, Any], duration_s: float, wait: bool, plot: Path | None, as_json: bool
) -> None:
    from servod.client.control import Refused

    draw = _drawing(plot, motion, duration_s, wait)
    with connect(socket) as client:
        if not wait:
            result = client.call("track", renew_s=None, **motion)
            suggest("status", "--watch", why="Ctrl-C ends the watching, not the motion")
            report(result, "motion started", as_json)
            return
        watched = _Watched(client, draw is not None)
        with _progress(duration_s, as_json) as on_progress:
            try:
                result = _run(client, motion, watched, on_progress)
            except (ServodError, KeyboardInterrupt) as error:
                with suppress(ServodError):
                    watched.look()
                moved = not isinstance(error, Refused | BadInput)  # these come before the first cycle of it
                if moved and (watched.document() or isinstance(error, AnswerIsNo)):
                    why = _INTERRUPTED if isinstance(error, KeyboardInterrupt) else str(error)
                    _show(watched, _BROKEN_OFF, draw, plot, as_json, f" ({why.rstrip('.')})")
                raise
    if as_json:
        print_json(result | {"figures": watched.document()})
    else:
        _suggest(watched.document(), plot)
    _show(watched, _DONE, draw, plot, as_json)


#: Draws packed cycle records under what was said of them, with the nodes that moved and further facts.
_Draw = Callable[[bytes, list[str], list[dict[str, Any]], dict[str, str]], None]


def _show(watched: _Watched, begins: str, draw: _Draw | None, plot: Path | None, quiet: bool, why: str = "") -> None:
    """Figures and picture of what was seen; the picture says `why` it ended, which the terminal is told as an error."""
    said = _in_words(watched.document(), begins)
    drawn = draw is not None and len(watched.kept) > RECORD.size
    if draw is not None and drawn:
        draw(bytes(watched.kept), [said[0].replace(begins, begins + why, 1), *said[1:]], watched.nodes, watched.facts)
    if not quiet:
        print("\n".join([*said, *([f"drawn: {plot}"] if drawn else [])]))


def _drawing(plot: Path | None, motion: dict[str, Any], duration_s: float, wait: bool) -> _Draw | None:
    """What draws packed cycle records, and what was said of them, into `plot`; what refuses it does so before the axis
    moves.
    """
    if plot is None:
        return None
    if not wait:
        raise BadInput("--plot", "--no-wait", "--wait: what has not run cannot be drawn")
    if duration_s > _LONGEST_PLOT_S:
        remedy = "a longer one is drawn from its recording (`servoctl record`, `servoctl plot`)"
        raise BadInput("--plot", f"a motion of {duration_s:g} s", f"at most {_LONGEST_PLOT_S:g} s; {remedy}")
    import servod.lab.report.figures.motion  # noqa: F401  # without the extra nothing shall move for a picture
    from servod.cli.plot import check_drawing, draw_cycles

    check_drawing("--plot", plot)
    title = f"servoctl track {motion['kind']}"
    return lambda raw, said, nodes, facts: draw_cycles(raw, title, plot, said, nodes, facts)


class _Watched:
    """The cycles of a motion as they come: their figures, and with `keep` they themselves."""

    def __init__(self, client: ControlClient, keep: bool) -> None:
        from servod.client.control import CycleStream
        from servod.kernels.scoring import MotionTally

        self._stream: CycleStream = CycleStream(client)
        self.tally: MotionTally = MotionTally(self._stream.count_rad)
        self.kept = bytearray()
        self.nodes: list[dict[str, Any]] = client.call("status")["nodes"] if keep else []
        self.facts: dict[str, str] = _gain_set(client) if keep else {}
        self._keep, self._unknown = keep, 0

    @property
    def lost(self) -> int:
        """Cycles that came too late to be seen."""
        return self._stream.lost

    def document(self) -> dict[str, Any] | None:
        """The figures as plain values; None where too little was seen."""
        figures = self.tally.figures()
        return figures.document() | {"lost_cycles": self.lost, "unknown_cycles": self._unknown} if figures else None

    def look(self) -> None:
        """Take what has come."""
        from servod.kernels.scoring import MotionCycle

        raw = self._stream.take()
        if self._keep and len(self.kept) < _MOST_KEPT_BYTES:
            self.kept += raw
        for r in map(CycleRecord._make, RECORD.iter_unpack(raw)):
            active = bool(r.reference_active)
            cycle = MotionCycle(1e-9 * r.time_ns, active, r.reference_rad, r.position_rad, r.torque_nm, r.missed)
            self.tally.add(cycle)
            self._unknown += active and not math.isfinite(r.reference_rad - r.position_rad)


def _gain_set(client: ControlClient) -> dict[str, str]:
    """The set that runs, as a fact of a page."""
    row = next((row for row in client.call("gains_list")["gains"] if row["active"]), None)
    return {"gain set": f"{row['name']} version {row['version']}, sha256 {row['sha256']}"} if row else {}


def _suggest(figures: dict[str, Any] | None, plot: Path | None) -> None:
    """What the figures give reason for."""
    if figures and figures["missed_cycles"]:
        suggest("bench", why="how well this machine keeps time")
    elif plot is None:
        suggest(*sys.argv[1:], "--plot", "motion.html", why="the same motion in pictures")


def _in_words(figures: dict[str, Any] | None, begins: str) -> list[str]:
    """What people read."""
    if figures is None:
        return [f"{begins}: too short for figures"]
    periods = figures["cycles"] + figures["missed_cycles"] + figures["lost_cycles"]
    begin = f" from {figures['judged_from_s']:g} s of the motion on" if figures["judged_from_s"] else ""
    return [
        f"{begins}: RMS error {figures['rms_error_mrad']:.4g} mrad, peak error {figures['max_error_mrad']:.4g} mrad"
        + begin
        + (f"; {figures['unknown_cycles']} cycles, which have no error, left out" if figures["unknown_cycles"] else ""),
        *([_settled_in_words(figures)] if begins == _DONE else []),
        f"peak torque {figures['peak_torque_nm']:.4g} N*m; {figures['missed_cycles']} of {periods} cycles "
        "missed" + (f"; {figures['lost_cycles']} cycles not seen" if figures["lost_cycles"] else ""),
    ]


def _settled_in_words(figures: dict[str, Any]) -> str:
    from servod.kernels.scoring import BAND_COUNTS, BAND_SHARE

    band = f"{figures['band_mrad']:.4g} mrad ({100 * BAND_SHARE:g} % of the travel, at least {BAND_COUNTS:g} counts)"
    if figures["settling_s"] is None:
        return f"not settled to {band} within the {figures['watched_s']:.2g} s after the reference had come to rest"
    return f"settling time {figures['settling_s']:.3f} s after the reference had come to rest, to {band}"


def _run(client: ControlClient, motion: dict[str, Any], watched: _Watched, on_progress: OnProgress) -> dict[str, Any]:
    """Start the motion and wait for its end; whatever interrupts it stops the axis before it ends the command."""
    from servod.client.processes import sigterm_as_interrupt

    with sigterm_as_interrupt():
        try:
            result = client.call("track", **motion)
            _wait_for_end(client, watched, on_progress)
        except KeyboardInterrupt:
            client.call("stop")
            raise
    return result


def _wait_for_end(client: ControlClient, watched: _Watched, on_progress: OnProgress) -> None:
    """Poll until the motion is over and what follows it was seen."""
    started, ended = time.monotonic(), None
    while True:
        time.sleep(_POLL_S)
        status = client.call("status")
        if status["axis"]["state"] != "ENABLED":
            raise AnswerIsNo(f"the motion ended with the axis in {status['axis']['state']}: {_why(status)}")
        if abandoned := status["motion"]["abandoned"]:
            raise AnswerIsNo(abandoned)
        watched.look()
        on_progress(time.monotonic() - started, status["motion"])
        if status["axis"]["motion_running"]:
            continue
        ended = ended or time.monotonic()
        if watched.tally.at_rest_s >= _WATCH_S or time.monotonic() - ended > 2.0 * _WATCH_S:
            return


@contextmanager
def _progress(duration_s: float, quiet: bool) -> Iterator[OnProgress]:
    """A bar on a terminal's standard error: time, reference and error; nothing elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    columns = (BarColumn(), TextColumn("{task.completed:.1f} of {task.total:.1f} s  {task.description}"))
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("", total=duration_s)

        def on_progress(elapsed_s: float, motion: dict[str, Any]) -> None:
            bar.update(task, completed=min(elapsed_s, duration_s), description=_where(motion))

        yield on_progress


def _where(motion: dict[str, Any]) -> str:
    """Reference and error of the status document in words; either is None while it is not finite."""
    if motion["stale"]:
        return "no feedback of the joint"
    reference, error = motion["reference_rad"], motion["following_error_rad"]
    if reference is None or error is None:
        return ""
    return f"reference {reference:+.4f} rad, error {1e3 * error:+.3f} mrad"


def _why(status: dict[str, Any]) -> str:
    """The faults that end a motion; an old warning does not."""
    ends = [f for f in status["faults"] if f["reaction"] not in ("NONE", "CLIP")]
    stopper = status["lease"]["stopped_by"]
    stopped = f"process {stopper} stopped it" if stopper else "it was stopped or disabled"
    return " ".join(f"{f['code']}: {f['cause']}" for f in ends) or stopped


# --- The file of a motion --------------------------------------------------------------------------------------------
# Reads the reference motion of `servoctl track csv`: checks it and puts it on the loop's time grid.


COLUMNS = ("t_s", "reference_rad")
#: Spreadsheets begin UTF-8 files with it.
_BYTE_ORDER_MARK = "\ufeff"


class MotionFile(NamedTuple):
    """The samples of a file, times in s that grow and positions in rad."""

    path: Path
    times: list[float]
    positions: list[float]

    def on_grid(self, period_s: float) -> list[float]:
        """Positions in rad, one for each period, linear between the samples.

        Raises BadInput when the motion is shorter than a period or longer than the loop's memory.
        """
        from servod.runtime.loop.channel import TRAJECTORY_SAMPLES

        length_s, longest_s = self.times[-1] - self.times[0], (TRAJECTORY_SAMPLES - 1) * period_s
        if not period_s <= length_s * (1.0 + 1e-9):
            raise BadInput(f"{self.path}: t_s", f"{length_s:g} s in all", f"at least one period of {period_s:g} s")
        if not length_s <= longest_s * (1.0 + 1e-9):
            raise BadInput(f"{self.path}: t_s", f"{length_s:g} s in all", _longest(longest_s, period_s))
        count = math.floor(length_s / period_s + 1e-6) + 1
        return [_at(self.times, self.positions, self.times[0] + k * period_s) for k in range(count)]


def _longest(longest_s: float, period_s: float) -> str:
    from servod.runtime.loop.channel import TRAJECTORY_SAMPLES

    return f"at most {longest_s:g} s, which is {TRAJECTORY_SAMPLES} samples at one for each {period_s:g} s"


def read_motion(path: Path) -> MotionFile:
    """The motion in `path`; raises BadInput (file, column, row)."""
    times, positions = _columns(path)
    if len(times) < 2:
        raise BadInput(f"{path}: t_s", f"{len(times)} rows", "at least 2 rows")
    return MotionFile(path, times, positions)


def _columns(path: Path) -> tuple[list[float], list[float]]:
    from servod.common.yaml import read_text

    text = read_text(path).removeprefix(_BYTE_ORDER_MARK)
    reader = DictReader(line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    if any(";" in name for name in reader.fieldnames or ()):
        raise BadInput(f"{path}: separator", "`;`", "`,` between columns, and a point in numbers")
    missing = [c for c in COLUMNS if c not in (reader.fieldnames or ())]
    if missing:
        found = ", ".join(map(str, reader.fieldnames or ())) or "an empty file"
        raise BadInput(f"{path}: {missing[0]}", found, "a CSV file with the columns t_s and reference_rad")
    rows = [[_number(path, name, row_number, row[name]) for name in COLUMNS] for row_number, row in _rows(reader)]
    times = [row[0] for row in rows]
    for row_number, (earlier, later) in enumerate(pairwise(times), start=3):
        if later <= earlier:
            raise BadInput(f"{path}: t_s, row {row_number}", f"{later} after {earlier}", "times that grow")
    return times, [row[1] for row in rows]


def _rows(reader: DictReader[str]) -> Iterable[tuple[int, dict[str, str | None]]]:
    """Rows with their number in the file; the header is row 1."""
    return enumerate(reader, start=2)


def _number(path: Path, column: str, row: int, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadInput(f"{path}: {column}, row {row}", repr(text), "a finite number")
    return value


def _at(times: list[float], positions: list[float], t_s: float) -> float:
    after = min(max(bisect_right(times, t_s), 1), len(times) - 1)
    t0, t1, x0, x1 = times[after - 1], times[after], positions[after - 1], positions[after]
    return x0 + (x1 - x0) * min(max((t_s - t0) / (t1 - t0), 0.0), 1.0)
