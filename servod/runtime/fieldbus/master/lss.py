"""LSS master (CiA 305): finds nodes that have no node id yet, and leaves them as they are. Off the control path.

Fast scan finds one unconfigured slave by its 128-bit identity, bit by bit: a slave answers when it agrees with all bits
so far, so silence is an answer too and its time-out is what the scan costs (about 60 silences for a node).
"""

from __future__ import annotations

import struct
from collections import deque
from enum import IntEnum
from typing import NamedTuple

from servod.runtime.fieldbus.cia import LSS_FROM_SLAVE_ID, LSS_TO_SLAVE_ID
from servod.runtime.fieldbus.master.network import BusNetwork


class LssCommand(IntEnum):
    """Command specifiers that are used here (CiA 305)."""

    SWITCH_GLOBAL = 0x04
    IDENTIFY_SLAVE = 0x4F  # answer to fast scan
    IDENTIFY_NON_CONFIGURED_ANSWER = 0x50
    IDENTIFY_NON_CONFIGURED = 0x4C
    FAST_SCAN = 0x51


class LssIdentity(NamedTuple):
    """The LSS address: object 0x1018, sub-index 1 to 4."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int


_WAITING, _CONFIGURATION = 0, 1
_FAST_SCAN = struct.Struct("<BIBBB")
_CONFIRM_ALL = 128  # bit check value that any unconfigured slave answers
_PARTS, _BITS = 4, 32
#: After an answer others may still be on their way; taken for answers to the next request they would falsify it.
_SETTLE_S = 0.005


class LssMaster:
    """LSS services on a network; `answer_s` is how long an answer may take."""

    def __init__(self, network: BusNetwork, answer_s: float = 0.02) -> None:
        self._network = network
        self._answer_s = answer_s
        self._answers: deque[bytes] = deque(maxlen=128)
        network.subscribe(LSS_FROM_SLAVE_ID, self._on_answer)

    def _on_answer(self, _can_id: int, data: bytearray, _time_ns: float) -> None:
        self._answers.append(bytes(data))

    def _ask(self, request: bytes, answer: int) -> bytes | None:
        """Send a request, wait for an answer with this command specifier; None when none came."""
        self._answers.clear()
        self._network.send_message(LSS_TO_SLAVE_ID, request.ljust(8, b"\0"))

        def came() -> bool:
            return any(data and data[0] == answer for data in self._answers)

        if not self._network.wait(came, self._answer_s):
            return None
        self._network.wait(lambda: False, _SETTLE_S)
        return next(data for data in self._answers if data and data[0] == answer)

    def switch_all(self, configuration: bool) -> None:
        """Put all slaves into configuration or waiting state; nobody answers, so they get an answer's time to act."""
        state = _CONFIGURATION if configuration else _WAITING
        self._network.send_message(LSS_TO_SLAVE_ID, bytes((LssCommand.SWITCH_GLOBAL, state)).ljust(8, b"\0"))
        self._network.wait(lambda: False, self._answer_s)

    def unconfigured_present(self) -> bool:
        """Whether any slave without a node id answers (identify non-configured)."""
        request = bytes((LssCommand.IDENTIFY_NON_CONFIGURED,))
        return self._ask(request, LssCommand.IDENTIFY_NON_CONFIGURED_ANSWER) is not None

    def fast_scan(self) -> LssIdentity | None:
        """Identity of one unconfigured slave, which is in configuration state then; None when there is none."""
        if not self._agrees(0, _CONFIRM_ALL, 0, 0):
            return None
        parts = [0] * _PARTS
        for part in range(_PARTS):
            for bit in reversed(range(_BITS)):
                if not self._agrees(parts[part], bit, part, part):
                    parts[part] |= 1 << bit
            if not self._agrees(parts[part], 0, part, (part + 1) % _PARTS):
                return None  # the slave vanished, or two answered and only one agrees with what was found
        return LssIdentity(*parts)

    def _agrees(self, number: int, bit: int, part: int, next_part: int) -> bool:
        request = _FAST_SCAN.pack(LssCommand.FAST_SCAN, number, bit, part, next_part)
        return self._ask(request, LssCommand.IDENTIFY_SLAVE) is not None
