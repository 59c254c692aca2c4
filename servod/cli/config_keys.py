"""`servoctl config keys`: what every key of an axis configuration means, from the file model itself."""

from __future__ import annotations

import difflib
import textwrap
from typing import TYPE_CHECKING, Annotated

import typer

from servod.cli.common import JsonOption, print_json
from servod.common.errors import BadInput

if TYPE_CHECKING:
    from servod.formats.config_keys import ConfigKey

_WIDTH = 118


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
    last = {name.rpartition(".")[2]: name for name in names}
    near = difflib.get_close_matches(key, [*names, *last], n=1)
    groups = ", ".join(dict.fromkeys(name.partition(".")[0] for name in names))
    return f"{groups}, or a key below" + "".join(f" (did you mean {last.get(name, name)}?)" for name in near)


def _print(rows: list[ConfigKey]) -> None:
    header = ("key", "type", "unit", "default", "range")
    table = [header, *(row[: len(header)] for row in rows)]
    widths = [max(len(line[i]) for line in table) for i in range(len(header) - 1)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, (*widths, 0), strict=True)) for line in table]
    print(lines[0].rstrip())
    for line, row in zip(lines[1:], rows, strict=True):
        print(line.rstrip())
        print(textwrap.fill(row.meaning, _WIDTH, initial_indent="    ", subsequent_indent="    "))
