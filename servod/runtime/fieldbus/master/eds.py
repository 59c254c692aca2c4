"""Reads EDS and DCF files as they come from makers: tolerant of what is harmless, loud about what was tolerated.

Off the control path. canopen reads the file; this module first mends what real files have and that parser refuses
(numbers such as `001`, duplicate keys and sections, Latin-1 text), and reports each. What cannot be read is BadInput.
"""

from __future__ import annotations

import configparser
import io
import logging
import re
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from canopen.objectdictionary.eds import import_eds

from servod.common.errors import BadInput
from servod.common.files import read_bytes

_SECTION = re.compile(r"^\s*\[([^\]]*)\]\s*$")
_OPTION = re.compile(r"^\s*([^=;\[\s][^=]*?)\s*=\s*(.*?)\s*$")
_PADDED_DECIMAL = re.compile(r"^0+([0-9]+)$")
_NUMBER_KEYS = frozenset(
    {"objecttype", "datatype", "defaultvalue", "parametervalue", "lowlimit", "highlimit", "pdomapping"}
    | {"subnumber", "nrofentries"}
)
_NO_NUMBER = re.compile(r"invalid literal for int\(\) with base \d+: (.*)", re.DOTALL)
#: The generic dictionary of each driver, for configurations that name no EDS; beside the drivers.
GENERIC_EDS = {"cia402": "amplifier.eds", "cia406": "encoder.eds"}


@dataclass(frozen=True)
class Dictionary:
    """An object dictionary and what had to be mended to read it."""

    source: str
    objects: Any  # canopen.ObjectDictionary
    report: list[str] = field(default_factory=list)


def mend(text: str) -> tuple[str, list[str]]:
    """The text with harmless deviations from CiA 306 mended, and one line of report for each."""
    lines, report = [], []
    sections: set[str] = set()
    keys: set[str] = set()
    skipping = False
    for number, line in enumerate(text.splitlines(), start=1):
        mended = line
        if section := _SECTION.match(line):
            name = section.group(1).strip()
            skipping, keys = name.lower() in sections, set()
            sections.add(name.lower())
            mended = f"[{name}]"
            if skipping:
                report.append(f"line {number}: section [{name}] stands twice, the second is ignored")
        elif (option := _OPTION.match(line)) and not skipping:
            mended = _mend_option(number, option.group(1), option.group(2), keys, report)
        lines.append("" if skipping else mended)
    return "\n".join(lines) + "\n", report


def _mend_option(number: int, key: str, value: str, keys: set[str], report: list[str]) -> str:
    if key.lower() in keys:
        report.append(f"line {number}: key {key} stands twice in its section, the second is ignored")
        return ""
    keys.add(key.lower())
    padded = _PADDED_DECIMAL.match(value)
    if padded and key.lower() in _NUMBER_KEYS:
        report.append(f"line {number}: {key}={value} read as decimal {int(value)}")
        return f"{key}={int(padded.group(1))}"
    return f"{key}={value}"


class _Warnings(logging.Handler):
    """Collects what canopen's parser warns of, so that it is reported and not lost in a log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def load_dictionary(path: str | Path, node_id: int) -> Dictionary:
    """Read an EDS or DCF for a node ($NODEID is replaced). Raises BadInput when it is no dictionary."""
    text, report = mend(_decode(read_bytes(path, "an EDS or DCF file")))
    warnings, parser_log = _Warnings(), logging.getLogger("canopen.objectdictionary.eds")
    parser_log.addHandler(warnings)
    try:
        objects = import_eds(io.StringIO(text), node_id)  # type: ignore[no-untyped-call]
    except (configparser.Error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadInput(str(path), _reason(error), "an EDS or DCF by CiA 306") from error
    finally:
        parser_log.removeHandler(warnings)
    if not len(objects):
        raise BadInput(str(path), "no object", "an EDS or DCF by CiA 306 with sections such as [1000]")
    return Dictionary(str(path), objects, report + warnings.lines)


def _reason(error: Exception) -> str:
    """What is wrong in the file, in its own words and not in the parser's."""
    if isinstance(error, configparser.NoOptionError):
        return f"no {error.option} in section [{error.section}]"
    if isinstance(error, configparser.Error):
        return error.message
    if isinstance(error, KeyError):
        return f"an entry of an object that has no section of its own: {error.args[0]}"
    found = _NO_NUMBER.search(str(error))
    return f"{found.group(1)} where a number stands" if found else "an entry of a kind that does not fit its object"


def _decode(raw: bytes) -> str:
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def dictionary_for(driver: str, eds: str | None, node_id: int) -> Dictionary:
    """The dictionary that a configuration means: its own file, or the driver's generic one."""
    if eds is not None:
        return load_dictionary(eds, node_id)
    if driver not in GENERIC_EDS:
        raise BadInput(f"driver {driver}: eds", "nothing", "an EDS file: this driver has no generic dictionary")
    return _generic(driver, node_id)


@lru_cache(maxsize=16)
def _generic(driver: str, node_id: int) -> Dictionary:
    """A dictionary that ships; whoever brings up many axes in one process reads it once."""
    shipped = files("servod") / "drivers" / "eds" / GENERIC_EDS[driver]
    with as_file(shipped) as path:
        return load_dictionary(path, node_id)
