"""`servoctl faults`: the one table of faults, as log, command line and README show it."""

from __future__ import annotations

import typer

from servod.cli.common import JsonOption, example, print_json
from servod.errors import FAULTS

_HELP = example("List every fault, what it does to the axis, its cause and its remedy.", "servoctl faults")


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("faults", help=_HELP)(faults)


def faults(as_json: JsonOption = False) -> None:
    """Print the fault table."""
    if as_json:
        rows = FAULTS.values()
        print_json(
            [
                {
                    "code": f.code.name,
                    "bit": int(f.code),
                    "reaction": f.reaction.name,
                    "cause": f.cause,
                    "remedy": f.remedy,
                }
                for f in rows
            ]
        )
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("Fault", "Reaction", "Cause", "Remedy")
    for fault in FAULTS.values():
        table.add_row(fault.code.name, fault.reaction.name, fault.cause, fault.remedy)
    Console().print(table)
