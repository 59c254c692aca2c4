"""How long a frame takes on the wire, and who wins arbitration (ISO 11898-1).

Used by the hub. Lengths take the worst case of bit stuffing, from a table by data length, because counting the stuff
bits of every frame would cost more than everything else that the hub does; a bus that fits here fits in reality.
"""

from __future__ import annotations

from servod.runtime.fieldbus.bus import CAN_EFF_FLAG, CAN_RTR_FLAG

#: Bits of a base-format data frame with n data bytes: 8n+47 (with interframe space) and the stuff bits of 34+8n bits.
STANDARD_BITS = tuple(8 * n + 47 + (33 + 8 * n) // 4 for n in range(9))
#: The same for the extended format, whose stuffed part is 20 bits longer.
EXTENDED_BITS = tuple(8 * n + 67 + (53 + 8 * n) // 4 for n in range(9))
#: Error flag, delimiter and interframe space that follow a destroyed frame.
ERROR_BITS = 23


def frame_bits(can_id: int, data_bytes: int) -> int:
    """Worst-case length of a frame in bits; `can_id` with the kernel's flags."""
    length = 0 if can_id & CAN_RTR_FLAG else data_bytes
    return EXTENDED_BITS[length] if can_id & CAN_EFF_FLAG else STANDARD_BITS[length]


def arbitration_key(can_id: int) -> int:
    """The number that arbitration compares; the lowest wins. Base before extended, data before remote."""
    if can_id <= 0x7FF:
        return can_id << 21
    remote = 1 if can_id & CAN_RTR_FLAG else 0
    if can_id & CAN_EFF_FLAG:
        identifier = can_id & 0x1FFFFFFF
        return (identifier >> 18) << 21 | 1 << 20 | (identifier & 0x3FFFF) << 1 | remote
    return (can_id & 0x7FF) << 21 | remote << 19
