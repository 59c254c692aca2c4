"""Several scenarios in one file: `for_each` lists rows of values, and `$key` in the rest of the file stands for them.

A row has a `name`; its scenario is `file/name`. Where `$key` is a whole value, the row's value takes its place as
it is (a number, a list); inside a longer text it is put in as text. Between file and schema (servod.campaign.scenario).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from servod.errors import BadInput
from servod.yaml12 import parse_yaml, read_text

_KEY = "for_each"
_PLACE = re.compile(r"\$([a-z_]+)")


def variants(path: Path) -> Iterator[tuple[str, Any, str]]:
    """(name, data, where) of each scenario in the file at `path`. Raises BadInput."""
    data, where = parse_yaml(read_text(path), str(path)), str(path)
    if not isinstance(data, dict) or _KEY not in data:
        yield path.stem, data, where
        return
    common = {key: value for key, value in data.items() if key != _KEY}
    rows = data[_KEY]
    if not isinstance(rows, list) or not rows:
        raise BadInput(f"{where}: {_KEY}", repr(rows)[:80], "a list of rows, each with its values")
    names: set[str] = set()
    for number, row in enumerate(rows):
        here = f"{where}: {_KEY}.{number}"
        name = _name(row, here, names)
        names.add(name)
        yield f"{path.stem}/{name}", _filled(common, row, here), f"{where} ({name})"


def _name(row: Any, where: str, taken: set[str]) -> str:
    name = row.get("name") if isinstance(row, dict) else None
    if name is None or str(name) in taken:
        raise BadInput(where, repr(row)[:80], "a mapping with a `name` that no other row has")
    return str(name)


def _filled(value: Any, row: dict[str, Any], where: str) -> Any:
    """`value` with every `$key` replaced from `row`."""
    if isinstance(value, dict):
        return {key: _filled(item, row, where) for key, item in value.items()}
    if isinstance(value, list):
        return [_filled(item, row, where) for item in value]
    if not isinstance(value, str):
        return value
    whole = _PLACE.fullmatch(value)
    if whole:
        return _of(row, whole[1], where)
    return _PLACE.sub(lambda place: str(_of(row, place[1], where)), value)


def _of(row: dict[str, Any], key: str, where: str) -> Any:
    if key not in row:
        raise BadInput(where, f"no {key}", f"a value for ${key}")
    return row[key]
