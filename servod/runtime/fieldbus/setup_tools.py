"""Small tools of the set-up faces: writes that are read back, and objects that a device may lack.

Off the control path; stands on the SdoAccess of servod.runtime.fieldbus.devices, so that drivers never import the
master.
"""

from __future__ import annotations

from servod.common.errors import Unreachable
from servod.runtime.fieldbus.cia import Abort
from servod.runtime.fieldbus.devices import SdoAbort, SdoAccess

#: NO_DATA is what an error history says that is empty (CiA 301, 0x1003).
_ABSENT = (Abort.NO_SUCH_OBJECT, Abort.NO_SUCH_SUBINDEX, Abort.NO_DATA)


def write_checked(sdo: SdoAccess, index: int, subindex: int, value: int) -> None:
    """Write and read back; raises Unreachable naming object, wrote and read when the device kept something else."""
    sdo.write(index, subindex, value)
    read = sdo.read(index, subindex)
    if read != value:
        raise Unreachable(f"object 0x{index:04X}:{subindex}: wrote {value}, device reads {read}")


def read_optional(sdo: SdoAccess, index: int, subindex: int = 0) -> int | None:
    """Read an object that the device may lack: None when it does; raises as SdoAccess.read otherwise."""
    try:
        return sdo.read(index, subindex)
    except SdoAbort as abort:
        if abort.code in _ABSENT:
            return None
        raise


def write_optional(sdo: SdoAccess, index: int, subindex: int, value: int) -> bool:
    """Write and read back an object that the device may lack: False when it does."""
    try:
        write_checked(sdo, index, subindex, value)
    except SdoAbort as abort:
        if abort.code in _ABSENT:
            return False
        raise
    return True
