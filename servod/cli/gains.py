"""`servoctl gains`: load gain sets into the daemon, look at them, change between them while the axis runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    table_console,
)
from servod.cli.groups import stored_sets

if TYPE_CHECKING:
    from rich.table import Table

_app = typer.Typer(
    help=example("Load, list, show, activate and roll back gain sets.", "servoctl gains load my_axis.yaml"),
    rich_markup_mode=None,
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.add_typer(_app, name="gains")


@_app.command(help=example("Check a gain set and keep it in the daemon's store.", "servoctl gains load my_axis.yaml"))
def load(
    file: Annotated[Path, typer.Argument(help="Gain set, YAML.")],
    activate: Annotated[bool, typer.Option("--activate", help="Activate it as well.")] = False,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Load a gain set."""
    from servod.common.yaml import read_text
    from servod.formats.gains.gain_set import load_gains

    load_gains(file)  # refuse here, where the file's name is known
    with connect(socket) as client:
        result = client.call("gains_load", name=str(file), text=read_text(file))
        sealed = "; it came without a seal, the store's copy has one" if result["sealed"] else ""
        if activate:
            result |= client.call("gains_activate", name=result["name"], version=result["version"])
    report(result, f"{'activated' if activate else 'loaded'} {_title(result)}{sealed}", as_json)
    warn([result])


@_app.command("list", help=example("List the gain sets in the daemon's store.", "servoctl gains list"))
def list_(socket: SocketOption = DEFAULT_SOCKET, as_json: JsonOption = False) -> None:
    """List gain sets."""
    result = ask(socket, "gains_list")
    if as_json:
        print_json(result)
    else:
        _print(result)
    warn(result["gains"])


@_app.command(help=example("Check a gain set file and show what is in it.", "servoctl gains show my_axis.yaml"))
def show(file: Annotated[Path, typer.Argument(help="Gain set, YAML.")], as_json: JsonOption = False) -> None:
    """Show a gain set."""
    from servod.formats.gains.gain_set import load_gains, seal_fault

    gains = load_gains(file)
    document, problem, seal = gains.model_dump(mode="json"), gains.certificate_problem(), seal_fault(gains)
    if as_json:
        print_json(document | {"certificate_problem": problem, "seal_problem": seal and seal.problem})
        return
    from servod.cli import gains_view

    fits = "fits" if gains.seal else "none (the set has no design)"
    print(*gains_view.headline(gains), sep="\n")
    print(f"verdict: {gains_view.verdict(gains)}")
    print(f"seal: {seal.problem if seal else fits}")
    print(f"signature: {f'by {gains.signature.signer}, not checked here' if gains.signature else 'none'}")
    _print_tables(
        gains_view.parameter_table(gains), *gains_view.list_tables(gains), gains_view.certificate_table(gains)
    )


@_app.command(help=example("Change to a stored gain set, bumpless.", "servoctl gains activate my_axis"))
def activate(
    name: Annotated[str, typer.Argument(help="Name in the store.", autocompletion=stored_sets)],
    version: Annotated[int | None, typer.Option(min=1, help="Version; the newest unless given.")] = None,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Activate a gain set."""
    result = ask(socket, "gains_activate", name=name, version=version)
    report(result, f"activated {_title(result)}", as_json)
    warn([result])


@_app.command(help=example("Go back to the gain set that was active before.", "servoctl gains rollback"))
def rollback(socket: SocketOption = DEFAULT_SOCKET, as_json: JsonOption = False) -> None:
    """Roll back."""
    result = ask(socket, "gains_rollback")
    report(result, f"active again: {_title(result)}", as_json)
    warn([result])


def warn(rows: list[dict[str, Any]]) -> None:
    """Say on stderr what the daemon says of stored sets; it is no reason to refuse them."""
    for row in rows:
        if row["warning"]:
            print(f"warning: {row['name']} version {row['version']}: {row['warning']}", file=sys.stderr)


def _title(stored: dict[str, Any]) -> str:
    certified = "certified" if stored["certified"] else "not certified"
    return f"{stored['name']} version {stored['version']} (law {stored['law']}, {certified})"


def _print(result: dict[str, Any]) -> None:
    from servod.cli.gains_view import stored_table

    rows: list[dict[str, Any]] = result["gains"]
    if not rows:
        print("no gain set is stored")
        return
    _print_tables(stored_table(rows))
    for row in rows:
        if row["refused"]:
            print(f"refused: {row['name']} version {row['version']}: {row['refused']}")


def _print_tables(*tables: Table | None) -> None:
    """One after the other; texts of a file are shown as they stand."""
    console = table_console(markup=False)
    for table in tables:
        if table is not None:
            console.print()
            console.print(table)
