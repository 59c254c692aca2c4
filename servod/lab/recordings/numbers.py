"""Columns as they stand in a file, as float64: arrow columns, text as spreadsheets write it, numbers of four bytes.

Between the kinds of file and the recording.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput

Array = NDArray[np.float64]

#: Cells of text that are parsed at once: each is a Python object meanwhile.
_CELLS_AT_ONCE = 65_536
#: Numbers of four bytes that are widened at once.
_ROWS_AT_ONCE = 1_000_000
_WORDS = {"true": 1.0, "false": 0.0}
#: Thousands in groups of three, with one sign between them, as `1,234,567` or `1.234`.
_GROUPED = re.compile(r"[-+]?\d{1,3}(?:([.,' \u00a0\u202f])\d{3})(?:\1\d{3})*$")
_AMBIGUOUS = "a number; this one may be meant in thousands or as a fraction"


def numbers(column: Any, path: Path, name: str) -> Array:
    """A column as float64, NaN where a cell is empty. Raises BadInput naming the first cell that is no number."""
    if isinstance(column, np.ndarray):
        return widened(column)
    if column is None:
        raise BadInput(f"{path}: column {name}", "values that are no numbers", "numbers")
    import pyarrow as pa

    kind = column if isinstance(column, pa.DataType) else column.type
    try:
        return _converted(column, path, name)
    except (pa.ArrowException, ValueError, OverflowError):
        raise BadInput(f"{path}: column {name}", f"values of type {kind}", "numbers") from None


def element(column: Any, at: int, row: bool, path: Path, name: str) -> Any:
    """Column number `at` (or row, of a matrix that lies) of a matrix, or of cells that hold lists. Raises BadInput."""
    if column is None:
        raise BadInput(f"{path}: column {name}", "values that are no numbers", "a matrix of numbers, or lists of them")
    if isinstance(column, np.ndarray):
        if column.ndim != 2:
            raise BadInput(f"{path}: column {name}", "a column of single numbers", f"from: {name}")
        count = column.shape[0 if row else 1]
        if at >= count:
            last = f"{name}[{count - 1},:]" if row else f"{name}[:,{count - 1}]"
            raise BadInput(f"{path}: column {name}", f"{count} {'rows' if row else 'columns'}", f"up to {last}")
        return column[at] if row else column[:, at]
    import pyarrow as pa

    try:
        return _list_element(column, at, path, name)
    except (pa.ArrowException, ValueError, AttributeError) as error:
        found = (str(error).splitlines() or ["no lists"])[0]
        raise BadInput(
            f"{path}: column {name}, element {at}", found, "a list with as many numbers in each row"
        ) from None


def _list_element(column: Any, at: int, path: Path, name: str) -> Any:
    """Element `at` of each list, or of each text `[1, 2, 3]`."""
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = column if isinstance(column, pa.DataType) else column.type
    if pa.types.is_string(kind) and not isinstance(column, pa.DataType):
        inner = pc.utf8_trim(column, characters=" []()")
        column = pc.split_pattern_regex(inner, pattern=r"\s*[,;]\s*|\s+")
    elif isinstance(column, pa.DataType) or not (pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)):
        raise BadInput(f"{path}: column {name}", f"values of type {kind}", "lists of numbers")
    return pc.list_element(column, at)


def widened(values: NDArray[Any]) -> Array:
    """Numbers as float64, those of four bytes as the shortest decimals that they stand for: 12.345 s is 12.345 s, not
    12.345000267028809 s, and steps of a millisecond stay even.
    """
    with np.errstate(invalid="ignore"):  # a signalling NaN
        wide = values.astype(np.float64, copy=False)
    if values.dtype.kind != "f" or values.dtype.itemsize != 4:
        return wide
    flat = wide.reshape(-1)  # a copy of four bytes wide numbers is whole: no other array is written to
    for start in range(0, len(flat), _ROWS_AT_ONCE):
        part = flat[start : start + _ROWS_AT_ONCE]
        single, open_rows = part.astype(np.float32), np.flatnonzero(np.isfinite(part) & (part != 0.0))
        power = np.floor(np.log10(np.abs(part[open_rows])))
        for digits in range(6, 10):  # nine tell any two apart
            scale = 10.0 ** (digits - 1 - power)
            short = np.round(part[open_rows] * scale) / scale
            same = short.astype(np.float32) == single[open_rows]
            part[open_rows[same]] = short[same]
            open_rows, power = open_rows[~same], power[~same]
    return flat.reshape(wide.shape)


def _converted(column: Any, path: Path, name: str) -> Array:
    """Raises ValueError for an arrow type alone."""
    import pyarrow as pa

    if isinstance(column, pa.DataType):
        raise ValueError("no numbers stand in such a column")
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
    if holds_numbers(column.type):
        if pa.types.is_float32(column.type):
            return widened(np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float32))
        return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)
    return _parsed(column, path, name)


def holds_numbers(kind: Any) -> bool:
    """Whether numbers stand in an arrow column of this type."""
    import pyarrow as pa

    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    tests = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_boolean)
    return any(test(kind) for test in tests)


def _parsed(column: Any, path: Path, name: str) -> Array:
    """A column of text, or one that is empty all through."""
    values = np.full(len(column), np.nan)
    if column.null_count == len(column):
        return values
    decimal = next((sign for text in _texts(column) if (sign := decimal_sign(text))), None)
    for row, text in enumerate(_texts(column)):
        try:
            values[row] = number(text, decimal) if text else np.nan
        except ValueError as error:
            allowed = _AMBIGUOUS if error.args == (_AMBIGUOUS,) else "a number"
            raise BadInput(f"{path}: column {name}, row {row + 1}", repr(text)[:40], allowed) from None
    return values


def _texts(column: Any) -> Iterator[str]:
    for start in range(0, len(column), _CELLS_AT_ONCE):
        for cell in column.slice(start, _CELLS_AT_ONCE).to_pylist():
            yield "" if cell is None else str(cell).strip()


def decimal_sign(text: str) -> str | None:
    """The decimal sign that a cell shows beyond doubt; None where it shows none: 1,234 may be meant either way.

    >>> decimal_sign("1.234,5"), decimal_sign("0,25"), decimal_sign("1,234,567"), decimal_sign("1,234")
    (',', ',', '.', None)
    """
    commas, points = text.count(","), text.count(".")
    if commas and points:
        return "," if text.rfind(",") > text.rfind(".") else "."
    for sign, count, other in ((",", commas, "."), (".", points, ",")):
        if count > 1:
            return other
        if count == 1 and not _GROUPED.match(text):
            return sign
    return None


def number(text: str, decimal: str | None = None) -> float:
    """A cell as a spreadsheet writes it, with this decimal sign. Raises ValueError.

    >>> number("1.234,5", ","), number("-0,25", ","), number("1'234.5", "."), number("1e-3")
    (1234.5, -0.25, 1234.5, 0.001)
    """
    if decimal is None and "," in text:
        raise ValueError(_AMBIGUOUS)
    if (word := _WORDS.get(text.lower())) is not None:
        return word
    whole, sign, rest = text.partition(decimal or ".")
    if _GROUPED.match(whole):
        whole = re.sub("[^-+0-9]", "", whole)
    return float(f"{whole}.{rest}" if sign else whole)
