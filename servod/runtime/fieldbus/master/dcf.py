"""Writes the parameter values of a DCF to a node. Off the control path.

A DCF is an EDS with ParameterValue keys: how somebody configured this device with the maker's tool. Only the device's
own parameters (0x2000 and up) are taken from it: communication objects are the bring-up's, which verifies them, and
what acts when it is written (control word, set-points, outputs, presets) is nobody's to write from a file.
"""

from __future__ import annotations

from collections.abc import Iterator

from canopen.objectdictionary import ODVariable, datatypes

from servod.runtime.fieldbus.cia import acts_when_written
from servod.runtime.fieldbus.devices import SdoAccess
from servod.runtime.fieldbus.master.eds import Dictionary
from servod.runtime.fieldbus.setup_tools import write_checked

_FIRST_DEVICE_OBJECT = 0x2000
_WRITABLE = ("rw", "rww", "rwr")  # CiA 306; write-only objects are commands, not parameters


def parameters(dictionary: Dictionary) -> Iterator[tuple[int, int, int]]:
    """(index, subindex, value) of the device's parameters that the file gives a value, by rising index."""
    return (row for row in _values(dictionary) if not acts_when_written(row[0]))


def left_out(dictionary: Dictionary) -> list[int]:
    """Indices of the objects that the file gives a value, but that act when they are written."""
    return sorted({index for index, _, _ in _values(dictionary) if acts_when_written(index)})


def _values(dictionary: Dictionary) -> Iterator[tuple[int, int, int]]:
    """All writable integers of the device that the file gives a value."""
    for index in sorted(dictionary.objects):
        entry = dictionary.objects[index]
        for variable in (entry,) if isinstance(entry, ODVariable) else entry.values():
            writable = variable.access_type in _WRITABLE and variable.data_type in datatypes.INTEGER_TYPES
            if index >= _FIRST_DEVICE_OBJECT and writable and variable.value is not None:
                yield index, variable.subindex, variable.value


def write_parameters(sdo: SdoAccess, dictionary: Dictionary) -> int:
    """Write each value that the node does not have yet and read it back; how many were written. Raises as SDO does."""
    written = 0
    for index, subindex, value in parameters(dictionary):
        if sdo.read(index, subindex) != value:
            write_checked(sdo, index, subindex, value)
            written += 1
    return written
