"""`servoctl config`: `check` reads files of every kind before they are used, `keys` says what each key means."""

from __future__ import annotations

import difflib
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, print_json
from servod.common.errors import BadInput

if TYPE_CHECKING:
    from servod.formats.config import AxisConfig
    from servod.formats.config_keys import ConfigKey

_WIDTH = 118
#: Names that are told where a key is misspelt.
_MOST_NEAR = 2


def keys(
    key: Annotated[
        str | None,
        typer.Argument(metavar="[KEY]", help="Key, its last part, or a group, e.g. amplifier; none: all of them."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the keys, each with its meaning below it."""
    from servod.formats.config_keys import config_keys

    every = config_keys()
    found = [row for row in every if key is None or f".{row.key}".endswith(f".{key}") or row.key.startswith(f"{key}.")]
    if not found:
        raise BadInput("KEY", repr(key), _known(key or "", [row.key for row in every]))
    if as_json:
        print_json({"keys": [row._asdict() for row in found]})
    else:
        _print(found)


def _known(key: str, names: list[str]) -> str:
    """What would have been a key, in a few words; a misspelt last part is looked for in every group."""
    groups = list(dict.fromkeys(name.partition(".")[0] for name in names))
    parts = {part: [part] for part in (*groups, *names)}
    for name in names:
        parts.setdefault(name.rpartition(".")[2], []).append(name)
    near = [name for part in difflib.get_close_matches(key, parts, n=_MOST_NEAR) for name in parts[part]]
    meant = f" (did you mean {' or '.join(dict.fromkeys(near))}?)" if near else ""
    return f"{', '.join(groups)}, or a key below{meant}"


def _print(rows: list[ConfigKey]) -> None:
    header = ("key", "type", "unit", "default", "range")
    table = [header, *(row[: len(header)] for row in rows)]
    widths = [max(len(line[i]) for line in table) for i in range(len(header) - 1)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, (*widths, 0), strict=True)) for line in table]
    print(lines[0].rstrip())
    for line, row in zip(lines[1:], rows, strict=True):
        print(line.rstrip())
        print(textwrap.fill(row.meaning, _WIDTH, initial_indent="    ", subsequent_indent="    "))


_app = typer.Typer(
    help=example(
        "Check files before they are used; explain the keys of an axis configuration.",
        "servoctl config check /etc/servod/axis.yaml",
        "servoctl config keys amplifier",
    ),
    rich_markup_mode=None,
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.add_typer(_app, name="config")


@_app.command(
    short_help="Check files, each recognised by its content.",
    help=example(
        "Check axis configurations, gain sets, axis models, column maps and EDS files, each recognised by its content, "
        "with everything that they name. Values that weaken a guard, or lie beyond model and drive, are warned of.",
        "servoctl config check /etc/servod/axis.yaml gains.yaml model.yaml drive.eds",
    ),
)
def check(
    files: Annotated[list[Path], typer.Argument(help="Files to check.", metavar="FILE...")],
    as_json: JsonOption = False,
) -> None:
    """Check files; the first mistake ends the command with exit code 2, a warning does not."""
    found = [{"file": str(file), **_check(file)} for file in files]
    if as_json:
        print_json({"files": found})
        return
    for row in found:
        note = str(row["note"]).replace("; stopping:", "\n  stopping:")
        print(f"{row['file']}: {row['kind']}, no mistakes" + (f"; {note}" if note else ""))
        print(*(f"  warning: {line}\n" for line in row["warnings"]), sep="", end="")


_app.command(
    "keys",
    short_help="Explain the keys: type, unit, default, range, meaning.",
    help=example(
        "Explain the keys of an axis configuration: type, unit, default, range and meaning.",
        "servoctl config keys",
        "servoctl config keys gear_ratio",
    ),
)(keys)


def _check(file: Path) -> dict[str, Any]:
    from servod.common.yaml import parse_yaml, plain_name, read_text
    from servod.formats.kinds import TELLING, FileKind, kind_of

    if file.suffix.lower() in (".eds", ".dcf"):
        return {"kind": "EDS", "note": _check_eds(file), "warnings": []}
    keys = parse_yaml(read_text(file), str(file))
    if not isinstance(keys, dict):
        raise BadInput(str(file), f"{plain_name(keys)} at the top", "a mapping of keys")
    kind = kind_of(keys)
    if kind is None:
        known = "; ".join(f"{name}: {', '.join(sorted(telling))}" for name, telling in TELLING.items())
        raise BadInput(f"{file}: {', '.join(map(str, keys)) or '(top)'}", "keys of no known kind of file", known)
    if kind is FileKind.AXIS:
        return _check_axis(file)
    checks = {
        FileKind.GAINS: _check_gains,
        FileKind.MODEL: _check_model,
        FileKind.MAP: _check_map,
    }
    return {"kind": kind, "note": checks[kind](file), "warnings": []}


def _warnings(file: Path) -> list[str]:
    """What in a configuration without mistakes guards less than it seems."""
    from servod.formats.config import load_config
    from servod.formats.config_guards import weakened
    from servod.formats.model.axis_model import load_axis_model
    from servod.formats.wiring import with_expected

    config = with_expected(load_config(file))
    return weakened(config, load_axis_model(config.model) if config.model else None)


def _check_axis(file: Path) -> dict[str, Any]:
    """The configuration and everything that it names: drivers, quirks, EDS, gain set, model; and how it stops."""
    from servod.drivers.quirks import load_quirks
    from servod.formats.config import load_config
    from servod.formats.gains.gain_set import load_gains, require_fit
    from servod.formats.kinds import FileKind
    from servod.formats.stopping import UNKNOWN
    from servod.formats.wiring import brake_notes, with_expected
    from servod.runtime.fieldbus.master.planned import check_names, narrowed_by_stop, planned_bus_load

    config = load_config(file)
    notes = check_names(config, str(file))
    try:
        load_quirks(config.quirks)
    except BadInput as error:
        raise BadInput(f"{file}: {error.where}", error.found, error.allowed) from None
    for eds in (config.amplifier.eds, config.encoder.eds):
        if eds is not None:
            _check_eds(Path(eds))
    require_fit(load_gains(config.gains.initial), config, str(config.gains.initial))
    with_expected(config)
    notes += [*_open_wires(config), *brake_notes(config)]
    load = planned_bus_load(config, str(file))
    where = f"{config.bus.interface} {config.bus.channel}"
    try:
        _, stopping = narrowed_by_stop(config)
    except BadInput as error:
        raise BadInput(f"{file}: {error.where}", error.found, error.allowed) from None
    notes += [UNKNOWN] if stopping is None else stopping.lines()
    notes.insert(0, f"axis {config.name} on {where}, bus load {100.0 * load.share:.1f} % at {load.bit_rate} bit/s")
    return {
        "kind": FileKind.AXIS,
        "note": "; ".join(notes),
        "stopping": None if stopping is None else stopping.document(),
        "warnings": _warnings(file),
    }


def _open_wires(config: AxisConfig) -> list[str]:
    """Inputs of which a broken wire is not seen."""
    inputs = config.amplifier.inputs
    rows = (("estop", inputs.estop_bit, inputs.estop_active), ("sto", inputs.sto_bit, inputs.sto_active))
    return [
        f"amplifier.inputs.{name}_active is high: a broken wire is not seen, the input then never stops the axis"
        for name, bit, level in rows
        if bit is not None and level == "high"
    ]


def _check_gains(file: Path) -> str:
    """A set without a certificate is good, for a configuration may accept it; one that none may run is a mistake."""
    from servod.formats.gains.gain_set import load_gains, require_certificate

    gains = load_gains(file)
    require_certificate(gains, accept_uncertified=True, where=str(file))
    problem = gains.certificate_problem()
    return f"law {gains.law.name}, " + (f"not certified: {problem}" if problem else "certified")


def _check_model(file: Path) -> str:
    from servod.formats.model.axis_model import load_axis_model

    load_axis_model(file)
    return ""


def _check_map(file: Path) -> str:
    from servod.lab.recordings.columns import load_column_map

    load_column_map(file)
    return ""


def _check_eds(file: Path) -> str:
    from servod.runtime.fieldbus.master.eds import load_dictionary

    dictionary = load_dictionary(file, node_id=1)
    mended = f"; mended: {'; '.join(dictionary.report)}" if dictionary.report else ""
    return f"{len(dictionary.objects)} objects{mended}"
