"""The layout of a table of text, as its first lines tell it: separator, names, decimal sign, where the rows begin.

Under `text`. What a spreadsheet adds is taken away: a line `sep=;`, comments, a line of units beneath the names, names
without a column and columns without a name.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from servod.common.errors import BadInput
from servod.lab.recordings.bounds import by_number, refuse_repeated
from servod.lab.recordings.numbers import number

#: So much of a file is looked at: the longest header line.
HEAD_BYTES = 256 * 1024
#: Lines in front of the rows that are looked at.
_MOST_LINES = 64
_COMMENT = ("#", "%", "//")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?$")
_NOT_A_NUMBER = frozenset({"", "nan", "-nan", "null", "none", "na", "n/a", "#n/a", "-"})


@dataclass(frozen=True)
class Layout:
    """How a table of text is laid out.

    `names` are the columns' names, `cells` the same with those that have none, as many as a row has cells; a separator
    that is a blank stands for any number of them where `blanks` says so. `skip_bytes` lie in front of the first row.
    """

    names: tuple[str, ...]
    cells: tuple[str, ...]
    separator: str
    blanks: bool
    decimal: str
    skip_bytes: int
    notes: tuple[str, ...]


def find_layout(head: bytes, whole: bool, path: Path) -> Layout:
    """The layout that the first octets of a file show; `whole` where they are all of it. Raises BadInput."""
    notes: list[str] = []
    lines = _lines(head, whole, path, notes)
    at, separator, comment = 0, "", ""
    for at, line in enumerate(lines):  # noqa: B007
        bare = line.strip()
        if found := re.fullmatch(r'"?sep=(.)"?', bare, re.IGNORECASE):
            separator = found[1]
        elif bare.startswith(_COMMENT):
            comment = bare.lstrip("#%/").strip()
        elif bare:
            break
    else:
        raise BadInput(str(path), "an empty file", "a header line with column names")
    separator = separator or separator_of(lines[at], lines[at + 1 : at + 2])
    first = split(lines[at], separator)
    if not any(first):
        raise BadInput(str(path), "an empty file", "a header line with column names")
    named, rows = first, at + 1
    if _all_numbers(first):
        above = split(comment, separator_of(comment, ())) if comment else []
        named, rows = (above if len(above) == len(first) else []), at
    elif rows + 1 < len(lines) and _is_unit_row(split(lines[rows], separator), split(lines[rows + 1], separator)):
        notes.append(f"line {rows + 1} taken for units, not applied (a --map file does): {lines[rows].strip()[:120]}")
        rows += 1
    width = _width(first, [split(line, separator) for line in lines[rows : rows + 3]])
    names = _names(named, width, path)
    separator, blanks = (separator, False) if separator != " " else (" ", True)
    decimal = _decimal([split(line, separator) for line in lines[rows:]]) if separator != "," else "."
    skip = sum(len(line) for line in head.splitlines(keepends=True)[:rows])
    told = max((at + 1 for at, name in enumerate(named) if name), default=width)
    return Layout(tuple(names[:told]), tuple(names), separator, blanks, decimal, skip, tuple(notes))


def _lines(head: bytes, whole: bool, path: Path, notes: list[str]) -> list[str]:
    """The first lines as text. Raises BadInput where they are none."""
    found = head.splitlines(keepends=True)
    if not whole and len(found) > 1:
        found.pop()  # cut in the middle
    if b"\0" in head:
        raise BadInput(str(path), "bytes that are no text", "a text file with a header line")
    try:
        return [line.decode("utf-8").rstrip("\r\n") for line in found[:_MOST_LINES]]
    except UnicodeDecodeError:
        notes.append("the text is not UTF-8; its names are read as Windows writes them (cp1252)")
        return [line.decode("cp1252", "replace").rstrip("\r\n") for line in found[:_MOST_LINES]]


def separator_of(line: str, following: Sequence[str]) -> str:
    """The character between the cells of a line; a blank for any number of blanks and tabs."""
    outside = re.sub(r'"[^"]*"|\[[^]]*\]', "", line)
    below = re.sub(r'"[^"]*"|\[[^]]*\]', "", following[0]) if following else outside
    if ";" in outside and (outside.count(";") >= outside.count(",") or _all_numbers(split(line, ";"))):
        return ";"
    if "\t" in outside and outside.count("\t") >= outside.count(","):
        return "\t"
    words = outside.split()
    if "," in outside and not (len(words) > 1 and all(_DECIMAL_COMMA.match(word) for word in words)):
        return ","
    blank = len(words) > 1 and len(below.split()) > 1
    return " " if blank else ","


def split(line: str, separator: str) -> list[str]:
    """The cells of a line, without quotes and blanks around them."""
    if separator == " ":
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        cells = line.split(separator)
    return [cell.strip().strip('"').strip() for cell in cells]


def _all_numbers(cells: Sequence[str]) -> bool:
    told = [cell for cell in cells if cell]
    return (
        bool(told) and bool(cells[0]) and all(_is_number(cell) and cell.lower() not in _NOT_A_NUMBER for cell in told)
    )


def _is_number(cell: str) -> bool:
    try:
        number(cell, "," if _DECIMAL_COMMA.match(cell) else None)
    except ValueError:
        return False
    return True


def _is_unit_row(cells: Sequence[str], below: Sequence[str]) -> bool:
    """Words beneath the names, and numbers beneath the words."""
    told = [cell for cell in cells if cell.lower() not in _NOT_A_NUMBER]
    return bool(told) and not any(map(_is_number, told)) and any(_is_number(cell) for cell in below if cell)


def _width(first: Sequence[str], rows: Sequence[Sequence[str]]) -> int:
    """Cells of a row: as many as the header has, but for empty ones at the end of either."""
    told = len(first)
    while told > 1 and not first[told - 1]:
        told -= 1
    for row in rows:
        if row and any(row) and len(row) != len(first):
            return len(row) if len(row) >= told and not any(row[len(first) :]) else len(first)
    return len(first)


def _names(named: Sequence[str], width: int, path: Path) -> list[str]:
    """A name for every cell, its number where it has none. Raises BadInput for one that stands twice."""
    refuse_repeated([name for name in named if name], path)
    told = dict(enumerate(named))
    return [told.get(at) or by_number(at) for at in range(width)]


def _decimal(rows: Sequence[Sequence[str]]) -> str:
    """The decimal sign of a table whose cells no comma parts."""
    return "," if any(_DECIMAL_COMMA.match(cell) for row in rows for cell in row) else "."
