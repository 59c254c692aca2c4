"""`servoctl diagnose`: where recordings and model differ, what physics was left out, and the model with it put in.

Works on files alone; needs the lab extra.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, need_folder, one_thread, print_json, same_file, suggest
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.files import is_there

if TYPE_CHECKING:
    from servod.formats.model.axis_model import AxisModel
    from servod.lab.diagnose.result import Diagnosis
    from servod.lab.recordings import Recording

EXAMPLE = "servoctl diagnose --model model.yaml run1.csv.gz run2.csv.gz --out diagnosis"


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="diagnose", help=example("Find what physics a model leaves out.", EXAMPLE))(diagnose)


def diagnose(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="REC...", help="CSV, text, Parquet, MAT v5, npy, JSON or MCAP.")
    ],
    model: Annotated[Path, typer.Option(help="Axis model (YAML) that the recordings are compared with.")],
    out: Annotated[Path, typer.Option(help="Folder for diagnosis.json, model.yaml and report.html.")],
    map_file: Annotated[
        Path | None, typer.Option("--map", help="Names and units of foreign columns: YAML, or a shipped map.")
    ] = None,
    from_s: Annotated[float | None, typer.Option(help="First time of the RECs to use, s.")] = None,
    to_s: Annotated[float | None, typer.Option(help="Time of the RECs to stop before, s.")] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds after which the search ends with what it has.")] = 120.0,
    hold_out: Annotated[
        list[Path] | None,
        typer.Option(metavar="REC", help="A recording that judges the answer and is in no fit; repeat."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare RECs with MODEL, name what is missing, write the extended model. Exit code 1: these data cannot tell."""
    if not 1.0 <= time_limit <= 1e5:
        raise BadInput("--time-limit", repr(time_limit), "seconds from 1 to 100000")
    one_thread()
    from servod.formats.model.axis_model import load_axis_model
    from servod.lab.diagnose.engine import diagnose as run
    from servod.lab.recordings import find_map
    from servod.lab.recordings.same import need_distinct
    from servod.lab.report.diagnosis import write_files
    from servod.lab.report.page import Origin

    map_file = find_map(map_file) if map_file else None
    axis = load_axis_model(model)
    _need_own_folder(out, model)
    recorded = [one.between(from_s, to_s) for one in _load(recordings, map_file, axis, model)]
    unseen = _load(hold_out or [], map_file, axis, model)
    need_distinct(recorded, unseen)
    need_folder("--out", out, alone=True)
    found = run(axis, recorded, time_limit, _quiet if as_json else _progress, unseen)
    sources: dict[str, Path | list[Path]] = {"model": model, "recordings": recordings, "held out": hold_out or []}
    origin = Origin({**sources, "map": [map_file] if map_file else []})
    document = write_files(out, found, model.name, origin)
    if as_json:
        print_json(document)
    else:
        _print(found, document, out)
    if found.evidence:
        suggest("replay", "--model", str(out / "model.yaml"), str(recordings[0]), why="with the physics added")
    if document["verdict"] == "cannot_tell":
        raise AnswerIsNo(document["summary"])


def _need_own_folder(out: Path, model: Path) -> None:
    """See that nothing of other origin in `out` would be overwritten. Raises BadInput."""
    from servod.lab.report.diagnosis import DOCUMENT, MODEL, PAGE

    if model.absolute() == (out / MODEL).absolute() or same_file(model, out / MODEL):
        raise BadInput("--model", str(model), "a file that the diagnosis in --out does not replace")
    there = [name for name in (MODEL, PAGE) if is_there(out / name)]
    if there and not is_there(out / DOCUMENT):
        raise BadInput(
            f"--out {out}", f"{', '.join(there)} without {DOCUMENT}", "an empty folder, or an earlier diagnosis"
        )


def _load(paths: list[Path], map_file: Path | None, axis: AxisModel, model: Path) -> list[Recording]:
    from servod.lab.recordings import load_recording

    recorded = [load_recording(path, map_file) for path in paths]
    for recording in recorded:
        if recording.axis is not axis.axis:
            wanted = f"{recording.axis.value}, as the columns of {recording.path} say"
            raise BadInput(f"{model}: axis", axis.axis.value, wanted)
    return recorded


def _quiet(_line: str) -> None:
    """No progress beside a JSON document."""


def _progress(line: str) -> None:
    """Progress on standard error."""
    print(line, file=sys.stderr, flush=True)


def _print(found: Diagnosis, document: dict[str, Any], out: Path) -> None:
    """The answer for people: verdict, findings with their parameters, what was recalibrated."""
    for refused in found.refused:
        print(f"not used: {refused.name}: {refused.reason}")
    for recording in document["recordings"]:
        for question in (note for note in recording["notes"] if "?" in note):
            print(f"note: {recording['name']}: {question}")
    print(f"{document['verdict']}: {document['summary']}")
    for finding in document["findings"]:
        print(f"- {finding['effect']} (confidence {finding['confidence']:.2f}): {finding['statement']}")
        for name, value in finding["parameters"].items():
            low, high = value["interval"]
            print(f"    {name} = {value['value']:.5g} {value['unit']}  [{low:.5g}, {high:.5g}]")
        for other in finding["alternatives"]:
            print(f"    not told apart from {other['effect']}: {other['experiment']}")
    for name, value in document.get("drive", {}).items():
        low, high = value["interval"]
        print(f"drive: {name} = {value['value']:.5g} {value['unit']}  [{low:.5g}, {high:.5g}]")
    for name, change in document["recalibrated"].items():
        print(f"recalibrated: {name} {change['from']:.5g} -> {change['to']:.5g} {change['unit']}")
    for name, windows in document.get("held_out", {}).items():
        for horizon, w in windows.items():
            errors = f"{w['before']:.3g} -> {w['after']:.3g} {w['unit']} (coasting {w['coasting']:.3g})"
            print(f"held out: {name}: windows of {horizon} s: {errors}")
    model = f", {out / 'model.yaml'}" if found.evidence else ""
    print(f"written: {out / 'diagnosis.json'}{model}, {out / 'report.html'}")
