"""`servoctl qualify soak`: hours of random moves and faults on the virtual axis, with every cycle accounted for."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Any

import typer

from servod.cli.common import JsonOption, example, need_folder, one_thread, print_json
from servod.common.errors import BadInput
from servod.common.portable import need_linux

_HELP = example(
    "Move the virtual axis at random for hours, let faults befall it, recover as a person would, and account for every "
    "cycle: loop counter, SYNC on the bus and recorded rows agree, every fault that is due in the log is there, none "
    "is without a cause, what the axis rides through left its trace on the bus, torque is gone in time by the drive's "
    "own record, memory stays flat. SYNC-stepped, so that a day takes two hours; --wall runs the real processes on the "
    "wall clock. Ctrl-C ends it and still reports. Exit code 1 when anything was wrong, and when it did not get "
    "through: interrupted, a job that died, four hours that do not tell of memory. The state is in --out all the "
    "time: soak.json, and soak.html at the end.",
    "servoctl qualify soak --hours 1",
    "servoctl qualify soak --hours 28 --limit-hours 1 --seed 7 --jobs 2 --out out/soak",
    "servoctl qualify soak --wall --hours 0.1",
)
_MS_PER_H = 3_600_000
_FEWEST_H, _MOST_H = 1e-4, 1e5


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("soak", help=_HELP, short_help="Hours of random moves and faults, every cycle told.")(soak)


def _hours(text: str) -> float:
    """A number of hours; typer's own range takes NaN for too large. Raises typer.BadParameter."""
    with contextlib.suppress(ValueError):
        if _FEWEST_H <= float(text) <= _MOST_H:
            return float(text)
    raise typer.BadParameter(f"{text} is not a number of hours from {_FEWEST_H:g} to {_MOST_H:g}.")


def soak(
    hours: Annotated[
        float, typer.Option(parser=_hours, metavar="HOURS", help="Axis time in hours, for each job.")
    ] = 0.5,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of schedule and noise.")] = 1,
    cycles: Annotated[int | None, typer.Option(min=1, help="Cycles of the loop instead of --hours.")] = None,
    wall: Annotated[bool, typer.Option("--wall", help="Real processes on the wall clock.")] = False,
    limit_hours: Annotated[
        float | None,
        typer.Option("--limit-hours", parser=_hours, metavar="HOURS", help="End after so much wall clock."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Independent axes, each with a seed of its own.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for state, report and the drive's record.")] = Path("out/soak"),
    as_json: JsonOption = False,
) -> None:
    """Soak."""
    if wall and jobs > 1:
        raise BadInput("--jobs", jobs, "1 with --wall: the processes of one axis want the machine for themselves")
    need_linux("servoctl qualify soak")
    need_folder("--out", out, alone=True)
    one_thread()
    from servod.cli.common import progress
    from servod.qualify.soak.launch import Order, launch

    order = Order(cycles or round(hours * _MS_PER_H), seed, wall, limit_hours, out)
    with progress("soak", quiet=as_json) as tell:
        found = launch(order, jobs, tell)
    if as_json:
        print_json(found)
    else:
        _print(found, out)
    if not found["passed"]:
        raise typer.Exit(1)


def _print(found: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from servod.qualify.soak.document import PAGE_NAME, count_rows, fault_rows, verdict

    console = Console()
    faults = Table("Fault", "Times", "In the log", "Ridden through", "Recovered", "Detected / ms", "Torque gone / ms")
    for name, injected, logged, ridden, recovered, _latched, _, detected, _, gone in fault_rows(found):
        faults.add_row(name, injected, logged, ridden, recovered, detected, gone)
    console.print(faults)
    counted = Table("Counted", "", show_header=False)
    for row in count_rows(found):
        counted.add_row(*row)
    console.print(counted)
    for finding in found["findings"][:10]:
        moment = "" if finding["time_s"] is None else f", {finding['time_s']:.3f} s"
        where = f"episode {finding['episode']}{moment}"
        console.print(f"{where}: {finding['wrong']}: {finding['text']}", highlight=False, markup=False)
    console.print(verdict(found), highlight=False)
    console.print(f"Report: {out / PAGE_NAME}", highlight=False, soft_wrap=True)
