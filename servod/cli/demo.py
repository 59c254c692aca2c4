"""`servoctl demo`: the virtual axis under four controllers, with a table of errors and a report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, print_json

if TYPE_CHECKING:
    from servod.demo.runs import Run

_HELP = example(
    "Run daemon and virtual axis, track the paper's trajectory (19) under PD, PD + DOB, PD + LuGre and the local-model "
    "law, and compare. Everything that is started is stopped again.",
    "servoctl demo",
    "servoctl demo --fast",
    "servoctl demo --plant my_axis.yaml --json",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("demo", help=_HELP)(demo)


def demo(
    fast: Annotated[
        bool, typer.Option("--fast", help="SYNC-stepped in virtual time instead of the wall clock.")
    ] = False,
    plant: Annotated[Path | None, typer.Option(help="Axis model (YAML) that the virtual axis is to be.")] = None,
    seconds: Annotated[float, typer.Option(min=2.0, max=30.0, help="Length of each run in s.")] = 30.0,
    out: Annotated[Path, typer.Option(help="Folder for report and recordings.")] = Path("out/demo"),
    as_json: JsonOption = False,
) -> None:
    """Run the demo."""
    from servod.axis_model import load_axis_model
    from servod.demo.axis import plant_file
    from servod.demo.runs import summary
    from servod.report.demo import write_demo_page

    model = plant_file(plant)
    load_axis_model(model)  # a bad file is refused before anything is started
    started = time.monotonic()
    runs = _run(fast, model, seconds, out, quiet=as_json)
    elapsed_s = time.monotonic() - started
    report = out / "report.html"
    write_demo_page(runs, report, stepped=fast, plant=model.name)
    document = summary(runs, elapsed_s) | {"mode": "stepped" if fast else "wall", "report": str(report)}
    if as_json:
        print_json(document)
    else:
        _print(document)


def _run(fast: bool, plant: Path, seconds: float, out: Path, quiet: bool) -> list[Run]:
    with _progress(quiet, seconds) as tell:
        if fast:
            from servod.demo.fast import run_fast

            return run_fast(plant, seconds, tell)
        from servod.demo.wall import run_wall

        return run_wall(plant, seconds, out / "recordings", tell)


@contextmanager
def _progress(quiet: bool, seconds: float) -> Iterator[Callable[[str, float], None]]:
    """A bar for each controller on standard error; nothing at all when quiet."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    from servod.demo.axis import CONTROLLERS, LABELS

    columns = (
        TextColumn("{task.description:12}"),
        BarColumn(),
        TextColumn("{task.completed:4.1f} of {task.total:.0f} s"),
    )
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), disable=quiet) as bars:
        tasks: dict[str, TaskID] = {c: bars.add_task(LABELS[c], total=seconds, start=False) for c in CONTROLLERS}

        def tell(controller: str, share: float) -> None:
            if share > 0.0:
                bars.start_task(tasks[controller])
            bars.update(tasks[controller], completed=share * seconds)

        yield tell


def _print(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from servod.demo.axis import LABELS

    table = Table(
        "Controller", "RMS error / mrad", "Largest error / mrad", title="Trajectory (19), first second left out"
    )
    for controller, score in document["controllers"].items():
        table.add_row(LABELS[controller], f"{score['rms_error_mrad']:.3f}", f"{score['max_error_mrad']:.3f}")
    console = Console()
    console.print(table)
    console.print(
        f"{document['cycles']} cycles, {document['missed']} missed, {document['wall_s']:.1f} s.", highlight=False
    )
    console.print(f"Report: {document['report']}", highlight=False, soft_wrap=True)
