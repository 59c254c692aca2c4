"""`servoctl plot`: a recording over time, as a page that keeps every cycle, and as a picture.

Works on files alone; needs the lab extra. What a state is called stands beside the machine (servod.runtime); the
drawing itself is the laboratory's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, need_file, report, suggest
from servod.common.errors import BadInput

if TYPE_CHECKING:
    from servod.formats.recording.mcap_reader import McapRecording
    from servod.lab.report.figures.motion import RecordedRun

_HELP = example(
    "Draw a recording over time: reference, error, torque and its parts, states, faults. Without --out a page and a "
    "picture are written into the current folder, named after the recording. On the page, drag over a part to see its "
    "every cycle.",
    "servoctl plot run.mcap",
    "servoctl plot run.mcap --from-s 12 --to-s 12.5 --out run.png",
)
PAGE, PICTURE = ".html", ".png"
#: Columns of the daemon's recordings that are drawn.
_DRAWN = frozenset({
    "position_rad", "reference_rad", "torque_nm", "torque_actual_nm", "torque_feedback_nm", "torque_friction_nm",
    "torque_other_nm", "axis_state", "drive_state", "controller", "faults", "missed",
})  # fmt: skip
#: Events that the page lists.
_MOST_EVENTS = 500
_NS_PER_S = 1e9


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("plot", help=_HELP)(plot)


def plot(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="MCAP, CSV, CSV.gz, Parquet or MAT v5.")],
    out: Annotated[Path | None, typer.Option(help="File to write, by its ending: .html or .png.")] = None,
    from_s: Annotated[float | None, typer.Option(help="First time of REC to draw, s.")] = None,
    to_s: Annotated[float | None, typer.Option(help="Time of REC to stop before, s.")] = None,
    map_file: Annotated[Path | None, typer.Option("--map", help="Renames and scales foreign columns (YAML).")] = None,
    as_json: JsonOption = False,
) -> None:
    """Draw REC."""
    files = [out] if out is not None else [Path(recording.name).with_suffix(kind) for kind in (PAGE, PICTURE)]
    for file in files:
        check_drawing("--out", file)
    whole, happened, damage = _load(recording, map_file)
    run = whole.between(from_s, to_s)
    if len(run.time_s) < 2:
        known = f"{whole.time_s[0]:g} to {whole.time_s[-1]:g} s" if len(whole.time_s) else "a recording with cycles"
        raise BadInput(f"{recording}: time", f"no two rows from {from_s} to {to_s} s", known)
    for file in files:
        draw(run, file, happened, made_from={"recording": recording})
    result = {
        "recording": str(recording),
        "rows": len(run.time_s),
        "from_s": float(run.time_s[0]),
        "to_s": float(run.time_s[-1]),
        "damage": damage,
        "files": [str(file) for file in files],
    }
    suggest("replay", "--model", "MODEL", str(recording), why="what a model makes of the same torque")
    lines = [f"note: {damage}"] if damage else []
    report(result, "\n".join([*lines, *(f"drawn: {file}" for file in files)]), as_json)


def check_drawing(option: str, file: Path) -> None:
    """Raise BadInput where `file` is neither page nor picture, or cannot be written."""
    if file.suffix not in (PAGE, PICTURE):
        raise BadInput(f"{option} {file}", repr(file.suffix), f"{PAGE} (a page) or {PICTURE} (a picture)")
    need_file(option, file)


def draw(
    run: RecordedRun,
    file: Path,
    happened: Sequence[tuple[str, str, str]] = (),
    said: Sequence[str] = (),
    made_from: Mapping[str, Path] | None = None,
    nodes: Sequence[Mapping[str, Any]] = (),
    facts: Mapping[str, str] | None = None,
) -> None:
    """Write `run` as a page or as a picture. Raises BadInput.

    The page begins with the first sentence of `said`, or without one with the figures of the run, and has `happened` as
    rows of time, kind and text. `nodes` are those of the daemon's status.
    """
    from servod.lab.report.figures.motion import describe_run, recorded_run

    first, *more = said or [describe_run(run)]
    figure = replace(recorded_run(run, file.stem), caption=f"{first.removesuffix('.')}.")
    if file.suffix == PICTURE:
        from servod.lab.report.pictures import write_pictures

        write_pictures(figure, file.parent, ("png",))
        return
    from servod.lab.report.figure import PageTable
    from servod.lab.report.page import Origin, Page, Verdict

    page = Page(run.title, Verdict(first), Origin(made_from or {}, nodes=nodes, facts=facts or {}))
    page.points(more)
    page.sentence("Drag over a part of a panel to see it closer, double-click to see all; all panels move together.")
    page.figure(figure)
    if happened:
        page.heading("What happened")
        page.table(PageTable("Events, as the supervisor saw them", ("told at / s", "kind", "what"), tuple(happened)))
    page.write(file)


def draw_cycles(
    raw: bytes,
    title: str,
    file: Path,
    said: Sequence[str],
    nodes: Sequence[Mapping[str, Any]] = (),
    facts: Mapping[str, str] | None = None,
) -> None:
    """Draw packed cycle records, under what was said of them; `nodes` and `facts` are those of the page's origin."""
    from servod.formats.recording.mcap_reader import McapRecording
    from servod.formats.recording.record import FIELDS

    kinds = "".join(field.kind for field in FIELDS)
    names, units = tuple(field.name for field in FIELDS), tuple(field.unit for field in FIELDS)
    draw(
        _of_cycles(McapRecording(names, kinds, units, bytearray(raw)), title), file, said=said, nodes=nodes, facts=facts
    )


def _load(path: Path, map_file: Path | None) -> tuple[RecordedRun, list[tuple[str, str, str]], str]:
    """A recording of the daemon's with its states and events, or any other one."""
    from servod.formats.recording.mcap_reader import read_recording

    if path.suffix == ".mcap" and map_file is None:
        from servod.lab.recordings.readers import MOST_CELLS

        cycles = read_recording(path, _DRAWN, MOST_CELLS)
        if "position_rad" not in cycles.names:
            raise BadInput(f"{path}: columns", ", ".join(cycles.names), "position_rad among them")
        return _of_cycles(cycles, path.name), _happened(cycles), cycles.damage
    from servod.lab.recordings import load_recording
    from servod.lab.report.figures.motion import RecordedRun

    found = load_recording(path, map_file)
    columns = {quantity.column(found.axis): values for quantity, values in found.columns.items()}
    return RecordedRun(path.name, found.t_s, columns), [], "; ".join(found.report)


def _of_cycles(cycles: McapRecording, title: str) -> RecordedRun:
    import numpy as np

    from servod.lab.report.figures.motion import RecordedRun
    from servod.runtime.fieldbus.devices import DriveState
    from servod.runtime.loop.axis import AxisState

    states = tuple(
        (column, words, tuple(state.name for state in kind))
        for column, words, kind in (("axis_state", "axis", AxisState), ("drive_state", "drive (CiA 402)", DriveState))
    )
    time_ns = np.asarray(cycles.column("time_ns"))
    begin_ns = time_ns[0] if len(time_ns) else 0
    columns = {name: np.asarray(cycles.column(name)) for name in cycles.names if name in _DRAWN}
    return replace(RecordedRun(title, (time_ns - begin_ns) / _NS_PER_S, columns), states=states)


def _happened(cycles: McapRecording) -> list[tuple[str, str, str]]:
    """Commands, faults and what nodes did, in seconds since the first cycle."""
    times_ns = cycles.column("time_ns")
    if not times_ns:
        return []
    rows: list[tuple[str, str, str]] = []
    for event in cycles.events[:_MOST_EVENTS]:
        at_ns: Any = event.get("time_ns")
        at = f"{(at_ns - times_ns[0]) / _NS_PER_S:.3f}" if isinstance(at_ns, int) else ""
        rows.append((at, str(event.get("kind", "")), str(event.get("text", ""))))
    return rows
