"""Emergency producer of a node: EMCY frames, error register 0x1001, error history 0x1003, inhibit time 0x1015.

Stands beside the node's other services; raised by the PDO engine, the heartbeat consumer and the application.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable

from servod.drivers.virtual.dictionary import DeviceDictionary, SdoRefusal
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.cia import Abort, Emcy, Obj301

_FRAME = struct.Struct("<HB5s")
_HISTORY = 8
_WAITING_LIMIT = 16
#: Error register bit by the class of the code (its high nibble): CiA 301, object 0x1001 and the EMCY code classes.
_REGISTER_BIT = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10, 0xF: 0x80}


class Emergency:
    """Errors that are present, and what the bus hears of them. `send(can_id, data)`; False when it may not be sent."""

    def __init__(self, dictionary: DeviceDictionary, send: Callable[[int, bytes], object], timeline: Timeline) -> None:
        self._dictionary, self._send = dictionary, send
        self._present: dict[int, int] = {}
        self._waiting: deque[bytes] = deque(maxlen=_WAITING_LIMIT)
        self._inhibit = timeline.timer(self._inhibit_over)
        self._register = dictionary.entry(Obj301.ERROR_REGISTER)
        self._history = [dictionary.entry(Obj301.ERROR_HISTORY, i) for i in range(_HISTORY + 1)]
        self._history[0].check = _only_zero
        self._history[0].written = self._clear_history
        for number, entry in enumerate(self._history[1:], start=1):
            entry.read = self._history_reader(number)

    def reset(self) -> None:
        """Forget present errors (reset of the node); the history stays."""
        self._present.clear()
        self._waiting.clear()
        self._inhibit.cancel()
        self._register.value = 0

    def present(self, code: int) -> bool:
        """True while `code` is raised."""
        return code in self._present

    def set(self, code: int, time_ns: int, detail: bytes = b"") -> None:
        """Raise `code`, once; `detail`: up to five bytes of the maker."""
        if code in self._present:
            return
        self._present[code] = _REGISTER_BIT.get(code >> 12, 0) | 0x01
        self._remember(code)
        self._announce(code, detail, time_ns)

    def clear(self, code: int, time_ns: int) -> None:
        """Take `code` back; the bus hears 0x0000 with what is left in the error register."""
        if self._present.pop(code, None) is not None:
            self._announce(Emcy.NONE, b"", time_ns)

    def _announce(self, code: int, detail: bytes, time_ns: int) -> None:
        register = 0
        for bits in self._present.values():
            register |= bits
        self._register.value = register
        self._waiting.append(_FRAME.pack(code, register, detail))
        if not self._inhibit.armed:
            self._inhibit_over(time_ns)

    def _inhibit_over(self, time_ns: int) -> None:
        """Send the oldest waiting frame and start the inhibit time anew; without one, send all."""
        identifier = self._dictionary.value(Obj301.EMCY_COB_ID)
        inhibit_ns = self._dictionary.value(Obj301.EMCY_INHIBIT) * 100_000
        while self._waiting:
            data = self._waiting.popleft()
            if not identifier & 0x80000000:
                self._send(identifier & 0x7FF, data)
            if inhibit_ns:
                self._inhibit.arm(time_ns + inhibit_ns)
                return

    def _remember(self, code: int) -> None:
        for older in range(_HISTORY, 1, -1):
            self._history[older].value = self._history[older - 1].value
        self._history[1].value = code
        self._history[0].value = min(self._history[0].value + 1, _HISTORY)

    def _clear_history(self, value: int) -> None:
        for entry in self._history:
            entry.value = 0

    def _history_reader(self, number: int) -> Callable[[], None]:
        def refuse_empty() -> None:
            if number > self._history[0].value:
                raise SdoRefusal(Abort.NO_DATA)

        return refuse_empty


def _only_zero(value: int) -> None:
    if value:
        raise SdoRefusal(Abort.VALUE_RANGE)
