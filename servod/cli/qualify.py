"""`servoctl qualify`: the project's own trials of itself: fault campaign, soak and paper; here is the campaign.

`servoctl qualify faults` puts every fault to the virtual axis and times what the drive does.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from fnmatch import fnmatchcase
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, need_folder, one_thread, print_json, table_console
from servod.cli.groups import scenario_groups
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.portable import need_linux
from servod.common.units import counted

if TYPE_CHECKING:
    from servod.qualify.faults.run import Outcome
    from servod.qualify.faults.scenario import Scenario

# --- The paper -------------------------------------------------------------------------------------------------------
# `servoctl qualify paper`: the paper's figures and numbers from this software on the virtual axis, and what agrees.


_PAPER_HELP = example(
    "Reproduce the paper on the virtual axis: identify Table I's joint and an asymmetric one, track trajectory (19) "
    "and steps under every controller over the whole CAN loop, sweep what the paper leaves open, and write figures, a "
    "page and the paper's numbers beside ours. Takes some minutes; --quick, without identification, a fraction of one.",
    "servoctl qualify paper --out out/paper",
    "servoctl qualify paper --out out/paper --quick --json",
)


def register_paper(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("paper", help=_PAPER_HELP, short_help="The paper's figures and numbers on the virtual axis.")(paper)


def paper(
    out: Annotated[Path, typer.Option(help="Folder for paper.html, paper.md, paper.json and pictures.")],
    quick: Annotated[
        bool, typer.Option("--quick", help="Table I's joint alone, as printed, short runs, no pictures.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise and excitations; the same gives the same.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Do the paper into OUT."""
    one_thread()
    from dataclasses import replace

    from servod.cli.common import progress
    from servod.qualify.paper.walk import QUICK, PaperPlan
    from servod.qualify.paper.walk import paper as run

    need_folder("--out", out, alone=True)
    plan = replace(QUICK if quick else PaperPlan(), seed=seed)
    with progress("paper", quiet=as_json) as on_progress:
        document = run(plan, out, on_progress)
    if as_json:
        print_json(document)
    else:
        print_document(document, out)


def print_document(document: dict[str, Any], out: Path) -> None:
    """Print the table of numbers, and how many statements of the paper hold here."""
    from servod.qualify.paper.table import numbers

    table = numbers(document)
    widths = [max(len(line[i]) for line in (table.header, *table.rows)) for i in range(len(table.header))]
    for line in (table.header, *table.rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
    claims = [claim for figure in document["figures"] for claim in figure["claims"]] + document["statements"]
    agree = sum(claim["agrees"] for claim in claims)
    print(f"{agree} of {len(claims)} statements of the paper hold here; {document['elapsed_s']:.0f} s.")
    print(f"Page: {out / 'paper.html'}; table and statements: {out / 'paper.md'}; pictures: {out / 'pictures'}")


# --- The soak --------------------------------------------------------------------------------------------------------
# `servoctl qualify soak`: hours of random moves and faults on the virtual axis, with every cycle accounted for.


_SOAK_HELP = example(
    "Move the virtual axis at random for hours, inject faults, recover as a person would, and account for every "
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
_RANGE = f"from {_FEWEST_H:g} to {_MOST_H:g}"


def register_soak(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("soak", help=_SOAK_HELP, short_help="Hours of random moves and faults; no cycle is lost.")(soak)


def _hours(text: str) -> float:
    """A number of hours; typer's own range takes NaN for too large. Raises typer.BadParameter."""
    with contextlib.suppress(ValueError):
        if _FEWEST_H <= float(text) <= _MOST_H:
            return float(text)
    raise typer.BadParameter(f"a number of hours {_RANGE}.")


def soak(
    hours: Annotated[
        float, typer.Option(parser=_hours, metavar="HOURS", help=f"Axis time of each job, in hours {_RANGE}.")
    ] = 0.5,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of schedule and noise.")] = 1,
    cycles: Annotated[int | None, typer.Option(min=1, help="Cycles of the loop instead of --hours.")] = None,
    wall: Annotated[bool, typer.Option("--wall", help="Real processes on the wall clock.")] = False,
    limit_hours: Annotated[
        float | None,
        typer.Option(
            "--limit-hours", parser=_hours, metavar="HOURS", help=f"End after so much wall clock, in hours {_RANGE}."
        ),
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
    with progress("soak", quiet=as_json) as on_progress:
        found = launch(order, jobs, on_progress)
    if as_json:
        print_json(found)
    else:
        _print(found, out)
    if not found["passed"]:
        raise typer.Exit(1)


def _print(found: dict[str, Any], out: Path) -> None:
    from rich.table import Table

    from servod.qualify.soak.document import PAGE_NAME, count_rows, fault_rows, verdict

    console = table_console()
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


_HELP = example(
    "Run the fault campaign on the virtual axis: every scenario injects its faults, the drive's own record says when "
    "torque was gone, and the table shows what the user is told. Scenarios in virtual time first, then those of "
    "daemon, loop and drive as processes on the wall clock, one at a time. The wiring test is off but where a "
    "scenario's file states wiring_proof in its `config`. Exit code 1 when one did not pass.",
    "servoctl qualify faults",
    "servoctl qualify faults --stepped --group encoder --out out/faults",
    "servoctl qualify faults --only 'torque_frames*' --json",
    "servoctl qualify faults --stepped --random 200 --seed 1",
    "servoctl qualify faults --scenario my_fault.yaml",
)


_app = typer.Typer(
    help=example("Try servod itself: fault campaign, soak, paper.", "servoctl qualify faults"), rich_markup_mode=None
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    _app.command("faults", help=_HELP, short_help="Put every fault to the virtual axis and time the drive.")(faults)
    register_soak(_app)
    register_paper(_app)
    app.add_typer(_app, name="qualify")
    for name, verb in (("soak", soak), ("paper", paper)):
        app.command(name, hidden=True, help=example("Has moved.", f"servoctl qualify {name}"))(_moved(name, verb))


def _moved(name: str, verb: Callable[..., None]) -> Callable[..., None]:
    """A verb in its old place: does the same, and says where it is now."""

    @wraps(verb)
    def here(**options: Any) -> None:
        print(f"servoctl: `servoctl {name}` is `servoctl qualify {name}` now; this name goes", file=sys.stderr)
        verb(**options)

    return here


def faults(
    only: Annotated[str | None, typer.Option(help="Run the scenarios whose name fits this pattern (*, ?).")] = None,
    group: Annotated[
        str | None, typer.Option(help="Run the scenarios of this group.", autocompletion=scenario_groups)
    ] = None,
    scenario: Annotated[
        list[Path] | None, typer.Option(help="Run the scenarios of this file instead; may be given again.")
    ] = None,
    stepped: Annotated[bool, typer.Option("--stepped", help="Leave out the scenarios on the wall clock.")] = False,
    random: Annotated[
        int | None,
        typer.Option(min=1, max=100_000, help="Draw so many instead: one thing fails at peak torque or top speed."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of --random; the same gives the same.")] = 1,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Scenarios in virtual time that run at once.")] = 1,
    out: Annotated[Path | None, typer.Option(help="Folder for the page and the document of the outcomes.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the campaign."""
    need_linux("servoctl qualify faults")
    if random is None:
        chosen = _chosen(scenario, only, group, stepped)
    else:
        from servod.qualify.faults.chance import drawn

        chosen = {name: s for name, s in drawn(random, seed).items() if fnmatchcase(name, only or "*")}
    if out is not None:
        need_folder("--out", out, alone=True)
    found: list[Outcome] = []
    try:
        _run(chosen, jobs, found, quiet=as_json)
    finally:  # interrupted, what came so far is shown and written
        _report(found, len(chosen), out, as_json)
    failed = [outcome.name for outcome in found if not outcome.passed]
    if failed:
        raise AnswerIsNo(f"{len(failed)} of {counted(len(found), 'scenario')} did not pass: {', '.join(failed)}")


def _chosen(files: list[Path] | None, only: str | None, group: str | None, stepped: bool) -> dict[str, Scenario]:
    """The scenarios to run. Raises BadInput for a broken file, and when nothing is left."""
    from servod.qualify.faults.scenario import Runs
    from servod.qualify.faults.variants import load_all, shipped_scenarios

    known = load_all(files) if files else shipped_scenarios()
    runs = {Runs.STEPPED} if stepped else {Runs.STEPPED, Runs.PROCESSES}
    here = {name: s for name, s in known.items() if s.runs in runs}
    groups = sorted({s.group for s in here.values()})
    if group is not None and group not in groups:
        raise BadInput("--group", group, ", ".join(groups))
    chosen = {name: s for name, s in here.items() if group in (None, s.group) and fnmatchcase(name, only or "*")}
    if not chosen:
        found = f"{only or 'all'}, which fits none of {counted(len(here), 'scenario')}"
        raise BadInput("--only", found, "a pattern that fits a name, as in 'torque_frames*'")
    return chosen


def _run(chosen: dict[str, Scenario], jobs: int, found: list[Outcome], quiet: bool) -> None:
    """Run them; each goes into `found`, and is told in a line of standard error, as it comes."""
    from servod.qualify.faults.run import outcomes

    for outcome in outcomes(chosen, jobs):
        found.append(outcome)
        if not quiet:
            why = "" if outcome.passed else f": {'; '.join(outcome.complaints)}"
            word = "passed" if outcome.passed else "FAILED"
            print(f"{len(found)} of {len(chosen)} {word} {outcome.name}{why}", file=sys.stderr, flush=True)


def _report(found: list[Outcome], planned: int, out: Path | None, as_json: bool) -> None:
    from servod.qualify.faults.run import document, summary, text_table

    content = document(found, planned)
    if out is not None:
        _write(found, planned, content, out)
    if as_json:
        print_json(content)
        return
    print(text_table(found))
    print("\n".join(summary(found, planned)))
    if out is not None:
        print(f"Page: {out / 'report.html'}; all figures: {out / 'faults.json'}")


def _write(found: list[Outcome], planned: int, content: dict[str, Any], out: Path) -> None:
    import json

    from servod.common.files import write_bytes
    from servod.qualify.faults.run import write_page

    write_bytes(out / "faults.json", json.dumps(content, indent=2, allow_nan=False).encode())
    write_page(found, planned, out / "report.html")
