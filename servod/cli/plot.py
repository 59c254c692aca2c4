"""`servoctl plot`: a recording over time, as a page that keeps every cycle, and as a picture.

Works on files alone; needs the lab extra. What a state is called stands beside the machine (servod.runtime); the
drawing itself is the laboratory's.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from servod.cli.common import JsonOption, example, need_file, report, suggest
from servod.common.errors import BadInput

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from servod.formats.config import AxisConfig
    from servod.formats.recording.mcap_reader import McapRecording
    from servod.lab.report.figures.motion import RecordedRun
    from servod.lab.report.page import Origin

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
    "torque_other_nm", "axis_state", "drive_state", "controller", "cycle", "faults", "missed",
})  # fmt: skip
#: Events that the page lists.
_MOST_EVENTS = 500
_NS_PER_S = 1e9
#: What happened: seconds since the first cycle, kind and text.
Event = tuple[float, str, str]


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("plot", help=_HELP)(plot)


def plot(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="MCAP, CSV, text, Parquet, MAT v5, npy or JSON.")],
    out: Annotated[Path | None, typer.Option(help="File to write, by its ending: .html or .png.")] = None,
    from_s: Annotated[float | None, typer.Option(help="First time of REC to draw, s.")] = None,
    to_s: Annotated[float | None, typer.Option(help="Time of REC to stop before, s.")] = None,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="Names and units of foreign columns: YAML, or a shipped map.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Draw REC."""
    files = [out] if out is not None else [Path(recording.name).with_suffix(kind) for kind in (PAGE, PICTURE)]
    for file in files:
        check_drawing("--out", file)
    from servod.lab.report.figures.motion import describe_run

    drawn = _load(recording, map_file)
    whole = drawn.run
    run = whole.between(from_s, to_s)
    if len(run.time_s) < 2:
        known = f"{whole.time_s[0]:g} to {whole.time_s[-1]:g} s" if len(whole.time_s) else "a recording with cycles"
        asked_for = (
            f"{'the begin' if from_s is None else f'{from_s:g} s'} to {'the end' if to_s is None else f'{to_s:g} s'}"
        )
        raise BadInput(f"{recording}: time", f"no two rows from {asked_for}", known)
    asked = from_s is not None or to_s is not None
    ends = (run.time_s[0], run.time_s[-1]) if asked else (-math.inf, math.inf)
    seen = [event for event in drawn.events if ends[0] <= event[0] <= ends[1]]
    for file in files:
        draw(run, file, seen, [describe_run(run), *drawn.notes], drawn.origin)
    result = {
        "recording": str(recording),
        "rows": len(run.time_s),
        "from_s": float(run.time_s[0]),
        "to_s": float(run.time_s[-1]),
        "damage": "; ".join([run.damage] if run.damage else drawn.notes),
        "files": [str(file) for file in files],
    }
    suggest("replay", "--model", "MODEL", str(recording), why="what a model makes of the same torque")
    lines = [f"note: {result['damage']}"] if result["damage"] else []
    report(result, "\n".join([*lines, *(f"drawn: {file}" for file in files)]), as_json)


def check_drawing(option: str, file: Path) -> None:
    """Raise BadInput where `file` is neither page nor picture, or cannot be written."""
    if file.suffix not in (PAGE, PICTURE):
        raise BadInput(f"{option} {file}", repr(file.suffix), f"{PAGE} (a page) or {PICTURE} (a picture)")
    need_file(option, file)


def draw(
    run: RecordedRun,
    file: Path,
    happened: Sequence[Event] = (),
    said: Sequence[str] = (),
    origin: Origin | None = None,
) -> None:
    """Write `run` as a page or as a picture. Raises BadInput.

    The page begins with the first sentence of `said`, or without one with the figures of the run, and lists what
    `happened` up to a bound. `origin` makes what the page states as its sources.
    """
    from servod.lab.report.figures.motion import describe_run, recorded_run

    first, *more = said or [describe_run(run)]
    figure = replace(recorded_run(run, file.stem), caption=f"{first.removesuffix('.')}.")
    if file.suffix == PICTURE:
        from servod.lab.report.pictures import write_pictures

        write_pictures(figure, file.parent, ("png",))
        return
    from servod.lab.report.figure import PageTable
    from servod.lab.report.page import Page, Verdict

    page = Page(run.title, Verdict(first), origin)
    page.points(more)
    counts = "t counts from the first cycle. " if run.states else ""
    page.sentence(f"{counts}Drag over a part of a panel to see it closer, double-click to see all; all move together.")
    page.figure(figure)
    if happened:
        page.heading("What happened")
        rows = tuple((f"{at_s:.3f}", kind, text) for at_s, kind, text in happened[:_MOST_EVENTS])
        page.table(PageTable("Events, as the supervisor saw them", ("told at t / s", "kind", "what"), rows))
        if unlisted := len(happened) - len(rows):
            page.sentence(f"{unlisted} more events are not listed: --from-s and --to-s draw a part with its own.")
    page.write(file)


def draw_cycles(
    raw: bytes,
    title: str,
    file: Path,
    said: Sequence[str],
    nodes: Sequence[Mapping[str, Any]] = (),
    facts: Mapping[str, str] | None = None,
) -> None:
    """Draw packed cycle records of this run of the machine, under what was said of them; `nodes` and `facts` are those
    of the page's origin.
    """
    from servod.formats.recording.mcap_reader import TIME, McapRecording
    from servod.formats.recording.mcap_writer import wall_offset_ns
    from servod.formats.recording.record import FIELDS
    from servod.lab.report.page import Origin

    kinds = "".join(field.kind for field in FIELDS)
    names, units = tuple(field.name for field in FIELDS), tuple(field.unit for field in FIELDS)
    cycles = McapRecording(names, kinds, units, bytearray(raw))
    recorded_ns = cycles.column(TIME)[0] + wall_offset_ns() if len(cycles) else None
    origin = Origin(nodes=nodes, facts=facts or {}, recorded_ns=recorded_ns)
    draw(_of_cycles(cycles, title), file, said=said, origin=origin)


class _Loaded(NamedTuple):
    """A recording that can be drawn, what happened in it, where it comes from, and what was repaired in it."""

    run: RecordedRun
    events: list[Event]
    origin: Origin
    notes: tuple[str, ...] = ()


def _load(path: Path, map_file: Path | None) -> _Loaded:
    """A recording of the daemon's with its states and events, an export of one with its states, or any other one."""
    from servod.formats.recording.mcap_reader import read_recording
    from servod.lab.report.page import Origin

    if path.suffix == ".mcap" and map_file is None:
        from servod.lab.recordings.readers import MOST_CELLS

        cycles = read_recording(path, _DRAWN, MOST_CELLS)
        if "position_rad" not in cycles.names:
            raise BadInput(f"{path}: columns", ", ".join(cycles.names), "position_rad among them")
        axis, facts = _attached(cycles)
        origin = Origin({"recording": path}, axis, facts=facts, sha256={path: cycles.sha256})
        return _Loaded(_of_cycles(cycles, path.name), _happened(cycles), origin)
    from servod.lab.recordings import find_map

    map_file = find_map(map_file) if map_file else None
    before = Origin({"recording": path, **({"map": map_file} if map_file else {})})
    exported = _exported(path) if map_file is None else None
    run, notes = (exported, ()) if exported else _foreign(path, map_file)
    if Origin(before.files).sha256 != before.sha256:
        raise BadInput(str(path), "a file that was changed while it was read", "one that nobody writes to meanwhile")
    return _Loaded(run, [], before, notes)


def _foreign(path: Path, map_file: Path | None) -> tuple[RecordedRun, tuple[str, ...]]:
    """Any other recording, and what was repaired in it; a position that was filled in has no error."""
    import numpy as np

    from servod.lab.recordings import Quantity, load_recording
    from servod.lab.report.figures.motion import RecordedRun

    found = load_recording(path, map_file)
    columns = {quantity.column(found.axis): values for quantity, values in found.columns.items()}
    columns[Quantity.POSITION.column(found.axis)] = np.where(found.measured, found.columns[Quantity.POSITION], np.nan)
    return RecordedRun(path.name, found.t_s, columns), found.report


def _exported(path: Path) -> RecordedRun | None:
    """What `servoctl record export` made of a recording: judged as that is; None for anything else."""
    import numpy as np

    from servod.formats.recording.record import FIELDS
    from servod.lab.recordings.readers import numbers, read_columns

    names, _ = read_columns(path, ())
    if not {"t_s", "time_ns", "position_rad", "axis_state"} <= set(names):
        return None
    found, _ = read_columns(path, {"t_s", *_DRAWN})
    columns = {name: numbers(found[name], path, name) for name in ("t_s", *_DRAWN) if name in found}
    whole = {field.name for field in FIELDS if field.kind == "q"}
    columns = {name: np.nan_to_num(values) if name in whole else values for name, values in columns.items()}
    time_s = columns.pop("t_s")
    return _run(path.name, time_s, columns) if np.all(np.diff(time_s) >= 0.0) else None


def _of_cycles(cycles: McapRecording, title: str) -> RecordedRun:
    import numpy as np

    time_ns = np.asarray(cycles.column("time_ns"))
    begin_ns = time_ns[0] if len(time_ns) else 0
    columns = {name: np.asarray(cycles.column(name)) for name in cycles.names if name in _DRAWN}
    serials = dict.fromkeys(columns["controller"].tolist()) if "controller" in columns else {}
    sets = [one.name for one in _gain_sets(cycles)]
    named = dict(zip(map(int, serials), sets, strict=True)) if len(sets) == len(serials) else {}
    run = _run(title, (time_ns - begin_ns) / _NS_PER_S, columns)
    return replace(run, sets=named, damage=cycles.damage)


def _run(title: str, time_s: NDArray[np.float64], columns: Mapping[str, NDArray[Any]]) -> RecordedRun:
    """Cycles of the daemon's, with the names of their states."""
    from servod.lab.report.figures.motion import RecordedRun
    from servod.runtime.fieldbus.devices import DriveState
    from servod.runtime.loop.axis_state import AxisState

    states = tuple(
        (column, words, tuple(state.name for state in kind))
        for column, words, kind in (("axis_state", "axis", AxisState), ("drive_state", "drive (CiA 402)", DriveState))
    )
    return RecordedRun(title, time_s, columns, states)


def _attached(cycles: McapRecording) -> tuple[AxisConfig | None, dict[str, str]]:
    """The axis that was recorded, and which gain sets ran: their files are in the recording. None of it must be."""
    from servod.common.yaml import parse_yaml, validate
    from servod.formats.config import AxisConfig

    axis, text = None, cycles.attachments.get("config.yaml", b"").decode(errors="replace")
    with contextlib.suppress(BadInput):  # of another version
        axis = validate(parse_yaml(text, "config.yaml"), AxisConfig, "config.yaml")
    sets = dict.fromkeys(f"{one.name}, sha256 {one.sha256}" for one in _gain_sets(cycles))
    return axis, ({"axis": axis.name} if axis else {}) | ({"gain set": "; then ".join(sets)} if sets else {})


class _Attached(NamedTuple):
    """A gain set in a recording; `sha256` is of its file, as the daemon's lists have it."""

    name: str
    sha256: str


def _gain_sets(cycles: McapRecording) -> list[_Attached]:
    """The gain sets that were attached, in the order in which they ran."""
    from servod.formats.gains.gain_set import parse_gains

    found = []
    for data in (data for name, data in cycles.attached if name == "gains.yaml"):
        with contextlib.suppress(BadInput):  # of another version
            name = parse_gains(data.decode(errors="replace"), "gains.yaml").name
            found.append(_Attached(name, hashlib.sha256(data).hexdigest()))
    return found


def _happened(cycles: McapRecording) -> list[Event]:
    """Commands, faults and what nodes did, in seconds since the first cycle."""
    times_ns = cycles.column("time_ns")
    if not times_ns:
        return []
    return [
        ((event["time_ns"] - times_ns[0]) / _NS_PER_S, str(event.get("kind", "")), str(event.get("text", "")))
        for event in cycles.events
        if isinstance(event.get("time_ns"), int)
    ]
