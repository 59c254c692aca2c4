"""`servoctl gains`: load gain sets into the daemon, look at them, change between them while the axis runs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
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
from servod.common.errors import BadInput
from servod.common.units import counted

if TYPE_CHECKING:
    from pydantic import BaseModel
    from rich.table import Table

    from servod.formats.gains.gain_set import GainSet
    from servod.formats.gains.parameters import LocalSet, PositionWave

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
    fits = "fits" if gains.seal else "none (the set has no design)"
    print(*headline(gains), sep="\n")
    print(f"verdict: {verdict(gains)}")
    print(f"seal: {seal.problem if seal else fits}")
    print(f"signature: {f'by {gains.signature.signer}, not checked here' if gains.signature else 'none'}")
    _print_tables(parameter_table(gains), *list_tables(gains), certificate_table(gains))


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


# --- As people read them ---------------------------------------------------------------------------------------------
# Gain sets as an engineer reads them: verdict in a word, parameters with unit and meaning, checks of the
# certificate; `--json` gives the same as data.


#: Units by the end of a key, the longer ends first.
_UNITS = {
    "_nm_per_rad3": "N·m/rad³",
    "_nms_per_rad": "N·m·s/rad",
    "_nm_per_rad": "N·m/rad",
    "_nm_per_s": "N·m/s",
    "_s_per_rad": "s/rad",
    "_per_turn": "per turn",
    "_kg_m2": "kg·m²",
    "_per_rad": "1/rad",
    "_per_s": "1/s",
    "_rad_s": "rad/s",
    "_nm": "N·m",
    "_rad": "rad",
    "_s": "s",
}
_LAWS = {
    "pd": "PD",
    "pd_dob": "PD with disturbance observer",
    "pd_lugre": "PD with LuGre friction observer",
    "local": "local-model gain-scheduled law",
}


def unit_of(key: str) -> str:
    """The unit that a key's name ends in; empty for a plain number."""
    return next((unit for end, unit in _UNITS.items() if key.endswith(end)), "")


def verdict(gains: GainSet) -> str:
    """Certified, uncertified or refused, and why; an axis may accept an uncertified set, but none that is refused."""
    from servod.formats.gains.gain_set import require_certificate

    problem = gains.certificate_problem()
    if problem is None:
        return "certified"
    try:
        require_certificate(gains, accept_uncertified=True)
    except BadInput as refusal:
        return f"refused: {problem}; wanted: {refusal.allowed}"
    return f"uncertified: {problem}; runs only with gains.accept_uncertified: true in the configuration"


def headline(gains: GainSet) -> list[str]:
    """Name, law, what it is and where it comes from."""
    source = gains.provenance
    lines = [f"{gains.name}: {_LAWS.get(gains.parameters.law, gains.parameters.law)}"]
    lines += [gains.description] if gains.description else []
    model = f"axis model {source.model_sha256[:12]}" if source.model_sha256 else "no axis model"
    recordings = counted(len(source.data_sha256), "recording") if source.data_sha256 else "no recordings"
    lines.append(f"made by {source.author} on {source.date} with {source.tool}, from {model} and {recordings}")
    if source.cross_checks:
        agree = sum(check.agrees for check in source.cross_checks)
        lines.append(f"a second solver agrees on {agree} of {len(source.cross_checks)} programmes")
    if source.note:
        lines.append(f"note: {source.note}")
    if gains.design is not None:
        lines.append(f"design: {gains.design.mode.value}, see --json")
    return [_plain(line) for line in lines]


def parameter_table(gains: GainSet) -> Table:
    """Every parameter with its unit and its meaning."""
    from rich.table import Column, Table

    table = Table(Column("parameter", no_wrap=True), "value", "unit", "meaning", box=None, padding=(0, 2, 0, 0))
    for name, value, meaning in _rows(gains.parameters):
        table.add_row(name, value, unit_of(name), meaning)
    return table


def list_tables(gains: GainSet) -> Iterator[Table]:
    """The lists among the parameters: a local set or a wave in each line."""
    from rich.table import Table

    for name, items in _lists(gains.parameters):
        rows = [item.model_dump() for item in items]
        heads = (f"{key} [{unit_of(key)}]" if unit_of(key) else key for key in rows[0])
        table = Table(*heads, title=name, title_justify="left", box=None, padding=(0, 2, 0, 0))
        for row in rows:
            table.add_row(*(_shown(value) for value in row.values()))
        yield table


def certificate_table(gains: GainSet) -> Table | None:
    """The checks of the certificate: figure, limit, margin."""
    from rich.table import Table

    certificate = gains.certificate
    if certificate is None or not certificate.checks:
        return None
    issued = _plain(f"certificate of {certificate.issued_by}, {certificate.issued_at:%Y-%m-%d %H:%M}")
    table = Table("check", "figure", "limit", "margin", "", title=issued, title_justify="left", box=None)
    for check in certificate.checks:
        figures = (f"{figure:.4g}" for figure in (check.value, check.limit, check.margin))
        table.add_row(_plain(check.name), *figures, "passed" if check.passed else "failed")
    return table


def stored_table(rows: list[dict[str, Any]]) -> Table:
    """What `gains_list` answers: a line for each version."""
    from rich.table import Table

    table = Table("name", "version", "law", "verdict", "", "sha256", box=None, padding=(0, 2, 0, 0))
    for row in rows:
        certified = "certified" if row["certified"] else "uncertified"
        running = "active" if row["active"] else ""
        sha256 = str(row["sha256"])[:12]
        table.add_row(
            row["name"], str(row["version"]), row["law"], "refused" if row["refused"] else certified, running, sha256
        )
    return table


def _rows(group: BaseModel, before: str = "") -> Iterator[tuple[str, str, str]]:
    """Name, value and meaning of each parameter that is no list of groups and not the law itself."""
    from pydantic import BaseModel

    for key, field in type(group).model_fields.items():
        value, name = getattr(group, key), f"{before}{key}"
        if isinstance(value, BaseModel):
            yield from _rows(value, f"{name}.")
        elif key != "law" and not _is_list_of_groups(value):
            yield name, _shown(value), field.description or ""


def _lists(group: BaseModel, before: str = "") -> Iterator[tuple[str, list[LocalSet | PositionWave]]]:
    from pydantic import BaseModel

    for key in type(group).model_fields:
        value = getattr(group, key)
        if isinstance(value, BaseModel):
            yield from _lists(value, f"{before}{key}.")
        elif _is_list_of_groups(value):
            yield f"{before}{key}", value


def _is_list_of_groups(value: Any) -> bool:
    from pydantic import BaseModel

    return isinstance(value, list) and any(isinstance(item, BaseModel) for item in value)


def _plain(text: str) -> str:
    """A text of the file in one line, with nothing that acts on a terminal."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))


def _shown(value: Any) -> str:
    """A value in words; a missing one is not set, and its meaning says what holds then."""
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(_shown, value)) or "none"
    return f"{value:.10g}" if isinstance(value, float) else str(value)
