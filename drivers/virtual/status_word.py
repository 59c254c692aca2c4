"""The status word 0x6041, put together from everything that it tells.

Used by the amplifier at each refresh.
"""

from __future__ import annotations

from servod.drivers.virtual.power_state import STATUS_BITS
from servod.runtime.fieldbus import cia
from servod.runtime.fieldbus.devices import DriveState

_FOLLOWING_ERROR = 1 << 13


def status_word(
    state: DriveState,
    *,
    supplied: bool,
    local: bool,
    warning: bool,
    limited: bool,
    reached: bool,
    follows: bool,
    following_error: bool,
) -> int:
    """The word; `follows` is bit 12 of the cyclic modes (set-point acknowledge in profile position)."""
    word = STATUS_BITS[state]
    if supplied:
        word |= cia.SW_VOLTAGE_ENABLED
    if state in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT):
        word |= cia.SW_QUICK_STOP  # no quick stop is active: the bit is active low
    if not local:
        word |= cia.SW_REMOTE
    if warning:
        word |= cia.SW_WARNING
    if limited:
        word |= cia.SW_INTERNAL_LIMIT
    if reached:
        word |= cia.SW_TARGET_REACHED
    if follows:
        word |= cia.SW_FOLLOWS_COMMAND
    if following_error:
        word |= _FOLLOWING_ERROR
    return word
