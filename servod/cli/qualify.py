"""`servoctl qualify`: the project's own trials of itself: fault campaign, soak and paper; here is the campaign.

`servoctl qualify faults` puts every fault to the virtual axis and times what the drive does.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from fnmatch import fnmatchcase
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli import paper, soak
from servod.cli.common import JsonOption, example, need_folder, print_json
from servod.cli.groups import scenario_groups
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.portable import need_linux

if TYPE_CHECKING:
    from servod.qualify.faults.run import Outcome
    from servod.qualify.faults.scenario import Scenario

_HELP = example(
    "Run the fault campaign on the virtual axis: every scenario injects its faults, the drive's own record says when "
    "torque was gone, and the table shows what the user is told. Scenarios in virtual time first, then those of "
    "daemon, loop and drive as processes on the wall clock, one at a time. The proof of the wiring is off but where a "
    "scenario's file states wiring_proof in its `config`. Exit code 1 when one did not pass.",
    "servoctl qualify faults",
    "servoctl qualify faults --stepped --group encoder --out out/faults",
    "servoctl qualify faults --only 'torque_frames*' --json",
    "servoctl qualify faults --scenario my_fault.yaml",
)


_app = typer.Typer(
    help=example("Try servod itself: fault campaign, soak, paper.", "servoctl qualify faults"), rich_markup_mode=None
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    _app.command("faults", help=_HELP, short_help="Put every fault to the virtual axis and time the drive.")(faults)
    soak.register(_app)
    paper.register(_app)
    app.add_typer(_app, name="qualify")
    for name, verb in (("soak", soak.soak), ("paper", paper.paper)):
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
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Scenarios in virtual time that run at once.")] = 1,
    out: Annotated[Path | None, typer.Option(help="Folder for the page and the document of the outcomes.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the campaign."""
    need_linux("servoctl qualify faults")
    chosen = _chosen(scenario, only, group, stepped)
    if out is not None:
        need_folder("--out", out, alone=True)
    found: list[Outcome] = []
    try:
        _run(chosen, jobs, found, quiet=as_json)
    finally:  # interrupted, what came so far is shown and written
        _report(found, len(chosen), out, as_json)
    failed = [outcome.name for outcome in found if not outcome.passed]
    if failed:
        raise AnswerIsNo(f"{len(failed)} of {len(found)} scenarios did not pass: {', '.join(failed)}")


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
        found = f"{only or 'all'}, which fits none of {len(here)} scenarios"
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
    from servod.qualify.faults.document import document, summary, text_table

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
    from servod.qualify.faults.document import write_page

    write_bytes(out / "faults.json", json.dumps(content, indent=2, allow_nan=False).encode())
    write_page(found, planned, out / "report.html")
