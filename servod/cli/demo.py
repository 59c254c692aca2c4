"""`servoctl demo`: the virtual axis under four controllers and a certified set, with a table of errors and a report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, need_folder, one_thread, print_json, progress, table_console
from servod.cli.groups import effects
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.portable import need_linux

if TYPE_CHECKING:
    from servod.qualify.demo.entries import DemoRow
    from servod.qualify.demo.runs import Run

_HELP = example(
    "Run daemon and virtual axis, track the paper's trajectory (19) under PD, PD + DOB, PD + LuGre and the local-model "
    "law, and compare. On the shipped joint the last row is a gain set that was synthesized and certified for it as "
    "identified. --gains adds rows; --fast adds three by itself there: the local law without options, and Table I "
    "in both readings. Everything that is started is stopped again.",
    "servoctl demo",
    "servoctl demo --fast --gains gains/demo_local_plain.yaml",
    "servoctl demo --plant my_axis.yaml --json",
    "servoctl demo --diagnose --fast --conceal asymmetry",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("demo", help=_HELP)(demo)


def demo(
    fast: Annotated[
        bool, typer.Option("--fast", help="SYNC-stepped in virtual time instead of the wall clock.")
    ] = False,
    plant: Annotated[Path | None, typer.Option(help="Axis model (YAML) that the virtual axis is to be.")] = None,
    gains: Annotated[
        list[Path] | None, typer.Option(help="Gain set to run beside the four controllers; may be given again.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=2.0, max=30.0, help="Length of each run in s.")] = 30.0,
    out: Annotated[Path, typer.Option(help="Folder for report and recordings.")] = Path("out/demo"),
    diagnose: Annotated[
        bool, typer.Option("--diagnose", help="Conceal an effect, diagnose it from the axis's recordings, and cure it.")
    ] = False,
    conceal: Annotated[
        str | None,
        typer.Option(
            help="Effect that --diagnose conceals, or takes out of what is believed of --plant.", autocompletion=effects
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the demo."""
    if diagnose:
        _diagnose(plant, conceal, fast, out, as_json)
        return
    if conceal is not None:
        raise BadInput("--conceal", conceal, "only with --diagnose")
    if not fast:
        need_linux("servoctl demo without --fast")
    from servod.formats.model.axis_model import load_rotary_model
    from servod.qualify.demo.axis import plant_file
    from servod.qualify.demo.entries import entries, further_files
    from servod.qualify.demo.report import Story, write_demo_page
    from servod.qualify.demo.runs import summary

    # Everything that can be refused is refused before anything is started.
    further = gains or (further_files() if fast and plant is None else [])
    model, rows = plant_file(plant), entries(further, certified=plant is None)
    load_rotary_model(model)
    recordings = out / "recordings"
    need_folder("--out", out, alone=True)
    if not fast:
        need_folder("--out", recordings)
    started = time.monotonic()
    runs, refused = _run(fast, model, seconds, rows, recordings, quiet=as_json)
    elapsed_s = time.monotonic() - started
    report = out / "report.html"
    write_demo_page(rows, runs, report, Story(model.name, fast, refused, model))
    document = summary(runs, elapsed_s) | {
        "mode": "stepped" if fast else "wall",
        "realtime_refused": refused,
        "report": str(report),
        "certified": {row.name: row.margins._asdict() for row in rows if row.margins},
    }
    if as_json:
        print_json(document)
    else:
        print_document(rows, document)


def _diagnose(plant: Path | None, conceal: str | None, fast: bool, out: Path, as_json: bool) -> None:
    """The other demo: an axis that conceals something; on Table I's joint unless another is given."""
    from servod.common.shipped import shipped
    from servod.qualify.demo.recovery.walk import DEFAULT

    joint = plant or shipped("gains/axes/table1_joint.yaml")
    demo_diagnose(joint, conceal or DEFAULT, fast, out, as_json)


def _run(
    fast: bool, plant: Path, seconds: float, rows: Sequence[DemoRow], recordings: Path, quiet: bool
) -> tuple[list[Run], list[str]]:
    """The runs, and the real-time rights that the loop was refused; none are asked for in virtual time."""
    with _progress(quiet, seconds, rows) as on_progress:
        if fast:
            from servod.qualify.demo.runs import run_fast

            return run_fast(plant, seconds, rows, on_progress), []
        from servod.qualify.demo.wall_clock import run_wall

        return run_wall(plant, seconds, rows, recordings, on_progress)


@contextmanager
def _progress(quiet: bool, seconds: float, rows: Sequence[DemoRow]) -> Iterator[Callable[[str, float], None]]:
    """A bar for each controller on standard error; nothing at all when quiet."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn(f"{{task.description:{max(len(row.label) for row in rows)}}}"),
        BarColumn(),
        TextColumn("{task.completed:4.1f} of {task.total:.0f} s"),
    )
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), disable=quiet) as bars:
        tasks: dict[str, TaskID] = {row.name: bars.add_task(row.label, total=seconds, start=False) for row in rows}

        def on_progress(controller: str, share: float) -> None:
            if share > 0.0:
                bars.start_task(tasks[controller])
            bars.update(tasks[controller], completed=share * seconds)

        yield on_progress


def print_document(rows: Sequence[DemoRow], document: dict[str, Any]) -> None:
    """Print the demo's document as a table for people, with what each law had and what the system refused."""
    from rich.table import Table

    from servod.qualify.demo.report import demo_verdict

    table = Table(
        "Controller", "RMS / mrad", "Largest / mrad", "Options", title="Error on trajectory (19), first second left out"
    )
    scores = document["controllers"] | document.get("others", {})
    for row in rows:
        score = scores[row.name]
        table.add_row(row.label, f"{score['rms_error_mrad']:.3f}", f"{score['max_error_mrad']:.3f}", row.options)
    console = table_console()
    console.print(demo_verdict({row.label: scores[row.name]["rms_error_mrad"] for row in rows}), highlight=False)
    console.print(table)
    console.print(
        f"{document['cycles']} cycles of the four, {document['missed']} missed, {document['wall_s']:.1f} s.",
        highlight=False,
    )
    for row in rows:
        if row.margins:
            console.print(f"{row.label}: {row.margins}.", highlight=False)
    if document["realtime_refused"]:
        refused = ", ".join(document["realtime_refused"])
        console.print(f"Refused by the system, so timing may suffer: {refused}.", highlight=False)
    console.print(f"Report: {document['report']}", highlight=False, soft_wrap=True)


# --- The story of a concealed effect ---------------------------------------------------------------------------------
# `servoctl demo --diagnose`: the story of an effect that was concealed, from its cost to its cure, in one command.


def demo_diagnose(plant: Path, effect: str, fast: bool, out: Path, as_json: bool) -> None:
    """Run the story on `plant` and print it. Raises AnswerIsNo when less than LEAST_RECOVERED comes back."""
    one_thread()
    from servod.client.open import daemon_axis, stepped_axis
    from servod.client.processes import sigterm_as_interrupt
    from servod.formats.model.axis_model import load_rotary_model
    from servod.qualify.demo.recovery.walk import LEAST_RECOVERED, believed_and_true, recover, write_recovery_page

    believed, true = believed_and_true(load_rotary_model(plant), effect)
    need_folder("--out", out, alone=True)
    begun = time.monotonic()
    with sigterm_as_interrupt(), progress("demo --diagnose", quiet=as_json) as on_progress:
        found = recover(believed, true, effect, stepped_axis if fast else daemon_axis, out, on_progress)
    report = write_recovery_page(found, out)
    document = found.summary() | {
        "mode": "stepped" if fast else "wall",
        "wall_s": time.monotonic() - begun,
        "report": str(report),
    }
    if as_json:
        print_json(document)
    else:
        _print(document)
    if document["recovered_share"] < LEAST_RECOVERED:
        share = f"{100.0 * document['recovered_share']:.0f} % of what {effect} cost came back"
        raise AnswerIsNo(f"{share}, at least {100.0 * LEAST_RECOVERED:.0f} % should")


def _print(document: dict[str, Any]) -> None:
    rms = document["rms_error_mrad"]
    found = ", ".join(f"{f['effect']} ({f['confidence']:.2f})" for f in document["findings"]) or document["verdict"]
    from servod.qualify.demo.recovery.walk import within

    share = {key: f"certified {within(scale)}" for key, scale in document["uncertainty_scale"].items()}
    print(f"as believed         {rms['before']:.4f} mrad RMS on trajectory (19), {share['before']}")
    print(f"{document['concealed']} concealed   {rms['concealed']:.4f} mrad")
    for line in document["broken_promises"]:
        print(f"promise broken: {line}")
    print(f"diagnosed: {found}")
    if not document["deployment"]["deployed"]:
        print(f"rolled back: {'; '.join(document['deployment']['reasons'])}")
    back = f"{100.0 * document['recovered_share']:.0f} % of the cost is back"
    print(f"after new design    {rms['after']:.4f} mrad, {share['after']}: {back}")
    print(f"Report: {document['report']}")
