"""`servoctl config`: `check` reads files of every kind before they are used, `keys` says what each key means."""

from __future__ import annotations

import difflib
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from servod.cli.common import JsonOption, example, print_json
from servod.common.errors import BadInput, details
from servod.common.files import named_in

if TYPE_CHECKING:
    from servod.formats.config import AxisConfig

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
    """Check all files; a mistake in any of them makes the exit code 2, a warning does not."""
    refused: list[BadInput] = []
    found = [{"file": str(file), **_check_or_tell(file, refused)} for file in files]
    if refused and len(files) == 1:
        raise refused[0]
    if as_json:
        print_json({"files": found})
    else:
        _print_checked([row for row in found if row["error"] is None])
    for error in refused[:-1]:
        print(f"servoctl: {error}", file=sys.stderr)
    if refused:
        raise refused[-1]


def _check_or_tell(file: Path, refused: list[BadInput]) -> dict[str, Any]:
    """The row of a file; what is wrong with it goes into `refused`, too."""
    try:
        return {**_check(file), "error": None}
    except BadInput as error:
        refused.append(error)
        mistake = {"message": str(error), **details(error)._asdict()}
        return {"kind": None, "note": "", "warnings": [], "error": mistake}


def _print_checked(found: list[dict[str, Any]]) -> None:
    """A line for each file without mistakes, and its warnings."""
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
    from servod.runtime.fieldbus.master.planned import check_names, narrowed_by_stop, planned_bus_load, reaction_s

    config = load_config(file)
    notes = check_names(config, str(file))
    try:
        load_quirks(config.quirks)
    except BadInput as error:
        raise BadInput(f"{file}: {error.where}", error.found, error.allowed) from None
    for device, eds in (("amplifier", config.amplifier.eds), ("encoder", config.encoder.eds)):
        if eds is not None:
            with named_in(f"{file}: {device}.eds"):
                _check_eds(Path(eds))
    with named_in(f"{file}: gains.initial"):
        initial = load_gains(config.gains.initial)
    with named_in(f"{file}: gains"):
        require_fit(initial, config, str(config.gains.initial))
    with named_in(f"{file}: model"):
        with_expected(config)
    notes += [*_open_wires(config), *brake_notes(config)]
    load = planned_bus_load(config, str(file))
    where = f"{config.bus.interface} {config.bus.channel}"
    try:
        _, stopping = narrowed_by_stop(config)
    except BadInput as error:
        raise BadInput(f"{file}: {error.where}", error.found, error.allowed) from None
    dead_ms = 1e3 * reaction_s(config)
    dead = f"stopping: when this computer dies, the drive goes on with its last command for up to {dead_ms:.0f} ms"
    notes += [UNKNOWN, dead] if stopping is None else stopping.lines()
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


# --- The keys of a configuration -------------------------------------------------------------------------------------
# The keys of an axis configuration as a table: type, unit, default, range and meaning, from the file model itself;
# docs/reference prints it as well.


#: Unit by the end of a key's name, the longest ends first.
_UNITS = {
    "_nm_per_s": "N·m/s",
    "_rad_s2": "rad/s²",
    "_rad_s": "rad/s",
    "_mnm": "mN·m",
    "_rad": "rad",
    "_mib": "MiB",
    "_nm": "N·m",
    "_us": "µs",
    "_ms": "ms",
    "_hz": "Hz",
    "_days": "d",
    "_s": "s",
    "_cycles": "cycles",
    "_counts": "counts",
}
#: Units that a key's name does not say.
_NAMED = {
    "bus.bit_rate": "bit/s",
    "bus.max_load": "share",
    "amplifier.counts_per_turn": "counts per motor turn",
    "amplifier.gear_ratio": "motor turns per joint turn",
    "encoder.counts_per_turn": "counts per joint turn",
    "stopping.least_inertia": "kg·m²",
    "stopping.least_viscous": "N·m·s/rad",
    "stopping.most_inertia": "kg·m²",
    "wiring_proof.inertia": "kg·m²",
}
_TYPES = {"null": "none", "string": "text", "object": "mapping", "number": "number", "integer": "integer"}


class ConfigKey(NamedTuple):
    """One key; all as text, an empty one where there is nothing to say. `default`: "required" where there is none."""

    key: str
    type: str
    unit: str
    default: str
    range: str
    meaning: str


def config_keys() -> list[ConfigKey]:
    """Every key of an axis configuration, in the order of the file, groups opened."""
    from servod.formats.config import AxisConfig

    schema = AxisConfig.model_json_schema()
    return list(_level(schema, schema, ""))


def _level(schema: dict[str, Any], here: dict[str, Any], prefix: str) -> Iterator[ConfigKey]:
    """The keys of one level; a group is followed by its own."""
    for name, field in here["properties"].items():
        group = field.get("$ref")
        if group:
            yield from _level(schema, schema["$defs"][group.rsplit("/", 1)[1]], f"{prefix}{name}.")
            continue
        key = prefix + name
        default = "required" if name in here.get("required", []) else _default(field)
        yield ConfigKey(key, _type(field), _unit(key), default, _range(field), field.get("description", ""))


def _default(field: dict[str, Any]) -> str:
    """A default as it would stand in the file."""
    default = field.get("default", {})
    if isinstance(default, bool):
        return str(default).lower()
    return "none" if default is None else str(default)


def _type(field: dict[str, Any]) -> str:
    if "anyOf" in field:
        return " or ".join(_type(option) for option in field["anyOf"])
    if field.get("format") == "path":
        return "path"
    kind = str(field.get("type", ""))
    return _TYPES.get(kind, kind)


def _range(field: dict[str, Any]) -> str:
    """What a value may be: the values themselves, or the ends of their range."""
    if "anyOf" in field:
        return ", ".join(filter(None, map(_range, field["anyOf"])))
    if "enum" in field:
        return ", ".join(str(value) for value in field["enum"])
    low, high = (_shown(field.get(end)) for end in ("minimum", "maximum"))
    if low and high:
        return f"{low} to {high}"
    if low or high:
        return f"at least {low}" if low else f"at most {high}"
    if "pattern" in field:
        return str(field["pattern"])
    return "not empty" if field.get("minLength") else ""


def _shown(end: float | None) -> str:
    """An end of a range, integers with all digits."""
    return "" if end is None else str(end) if isinstance(end, int) else f"{end:g}"


def _unit(key: str) -> str:
    if key in _NAMED:
        return _NAMED[key]
    return next((unit for end, unit in _UNITS.items() if key.endswith(end)), "")
