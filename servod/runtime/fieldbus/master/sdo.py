"""SDO access to one node: confirmed reads and writes by the node's own dictionary. Off the control path.

One lock per node, so that two threads never mix answers; an answer that names another object than was asked for is
somebody else's, or came too late, and counts for nothing. A time-out is told to the node by an abort frame, otherwise
its server stays busy. Lengths come from the EDS; an object that the EDS does not have is as absent as the device says.
"""

from __future__ import annotations

import queue
import struct
import threading
from collections import deque
from typing import Any, NamedTuple

from canopen.objectdictionary import ODVariable, datatypes
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from servod.common.errors import BadInput, Unreachable
from servod.runtime.fieldbus.cia import SDO_ANSWER_BASE, SDO_REQUEST_BASE, Abort
from servod.runtime.fieldbus.devices import SdoAbort
from servod.runtime.fieldbus.master.network import BusNetwork

#: Seconds to wait for the answer to one frame.
SDO_TIMEOUT_S = 0.6
#: Frames of SDO are never shorter or longer (CiA 301, 7.2.4.3).
_FRAME_BYTES = 8
#: More answers than this wait for nobody; more in one transfer come from a node that never ends it.
_MOST_WAITING, _MOST_ANSWERS = 64, 40_000
#: Longest number of CiA 301.
_MOST_NUMBER_BYTES = 8
_ABORT_REQUEST = struct.Struct("<BHBL")
_ABORT_COMMAND = 0x80
#: An upload's request, and the answer that carries the number and its size (CiA 301, 7.2.4.3.6).
_ASK = struct.Struct("<BHB4x")
_UPLOAD, _EXPEDITED, _EXPEDITED_MASK, _SIZED = 0x40, 0x42, 0xE2, 0x01
#: Answers that name their object: to the begin of an upload and of a download (7.2.4.3.3 and 7.2.4.3.6), by the three
#: highest bits. An abort names it too, but devices are known that fill in zeros.
_NAMING, _SPECIFIER_MASK = (0x40, 0x60), 0xE0
#: A question that nobody waits for is answered within this time, or lost.
_ASKED_S = 0.05

#: CiA 301 abort codes for people; the rest is said by the enum's name.
ABORT_TEXT: dict[int, str] = {
    Abort.READ_OF_WRITE_ONLY: "the object is write-only",
    Abort.WRITE_OF_READ_ONLY: "the object is read-only",
    Abort.NO_SUCH_OBJECT: "the device has no such object",
    Abort.NO_SUCH_SUBINDEX: "the object has no such sub-index",
    Abort.NOT_MAPPABLE: "the object cannot be mapped to a PDO",
    Abort.PDO_TOO_LONG: "the mapped objects exceed the PDO's length",
    Abort.INCOMPATIBLE_PARAMETER: "the parameter contradicts another one",
    Abort.LENGTH_MISMATCH: "the data length does not match the object",
    Abort.VALUE_RANGE: "the value is out of the object's range",
    Abort.VALUE_TOO_HIGH: "the value is too high",
    Abort.VALUE_TOO_LOW: "the value is too low",
    Abort.PRESENT_STATE: "not allowed in the device's present state (is it enabled?)",
}


def abort_text(code: int) -> str:
    """What an abort code means, in words."""
    if code in ABORT_TEXT:
        return ABORT_TEXT[code]
    try:
        return Abort(code).name.lower().replace("_", " ")
    except ValueError:
        return "unknown abort code"


class SdoAnswer(NamedTuple):
    """The number that a node gave, or None and the abort code."""

    value: int | None
    abort: int


class SdoNoAnswer(Unreachable):
    """The node did not answer an SDO request in time, or not to the point."""


class _Answers(queue.Queue[bytes]):
    """canopen's queue of answers; waiting on it pumps the network, on whichever clock that runs."""

    def __init__(self, network: BusNetwork) -> None:
        super().__init__()
        self._network = network
        self._answers: deque[bytes] = deque(maxlen=_MOST_WAITING)

    def put(self, item: bytes, block: bool = True, timeout: float | None = None) -> None:
        """Take an answer; called by the network's dispatch."""
        self._answers.append(item)

    def get(self, block: bool = True, timeout: float | None = None) -> bytes:
        """The next answer; raises queue.Empty after `timeout` seconds of the network's clock."""
        if not self._network.wait(lambda: bool(self._answers), timeout or 0.0):
            raise queue.Empty
        return self._answers.popleft()

    def empty(self) -> bool:
        """Whether no answer waits."""
        return not self._answers

    def clear(self) -> None:
        """Forget answers that came too late."""
        self._answers.clear()


class _Client(SdoClient):
    """canopen's SDO client with our queue, and with index and sub-index in its abort frames."""

    RESPONSE_TIMEOUT = SDO_TIMEOUT_S

    def __init__(self, node_id: int, dictionary: Any, network: BusNetwork) -> None:
        self._answers = _Answers(network)
        super().__init__(SDO_REQUEST_BASE + node_id, SDO_ANSWER_BASE + node_id, dictionary)  # type: ignore[no-untyped-call]
        self.network = network
        self.current = (0, 0)
        self._answered = 0

    def begin(self, index: int, subindex: int) -> None:
        """A new transfer, of this object; what is left of the last one goes."""
        self._answers.clear()
        self.current, self._answered = (index, subindex), 0

    def on_response(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """An answer of the server to this transfer; what is too short or long for one is none."""
        if len(data) != _FRAME_BYTES:
            return
        command, *named = _ASK.unpack(data)
        if command & _SPECIFIER_MASK not in _NAMING or tuple(named) == self.current:
            self._answers.put(bytes(data))

    def read_response(self) -> bytes:
        """The next answer. Raises SdoAbortedError, SdoCommunicationError."""
        self._answered += 1
        if self._answered > _MOST_ANSWERS:
            self.abort(Abort.OUT_OF_MEMORY)
            raise SdoCommunicationError(f"no end after {_MOST_ANSWERS} frames")
        answer: bytes = super().read_response()  # type: ignore[no-untyped-call]
        return answer

    @property
    def responses(self) -> _Answers:
        """The queue of answers."""
        return self._answers

    @responses.setter
    def responses(self, _fresh: object) -> None:
        self._answers.clear()  # canopen sets a new queue to drop what came too late

    def abort(self, abort_code: int = Abort.GENERAL) -> None:
        """Tell the server that this transfer is over."""
        self.network.send_message(self.rx_cobid, _ABORT_REQUEST.pack(_ABORT_COMMAND, *self.current, abort_code))


class NodeSdo:
    """servod.runtime.fieldbus.devices.SdoAccess to one node over the default SDO channel."""

    def __init__(self, network: BusNetwork, node_id: int, dictionary: Any) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self._lock = threading.Lock()
        self._network = network
        self._client = _Client(node_id, dictionary, network)
        network.subscribe(SDO_ANSWER_BASE + node_id, self._client.on_response)
        network.subscribe(SDO_ANSWER_BASE + node_id, self._on_answer)
        self._question: tuple[int, int] | None = None
        self._answer: SdoAnswer | None = None

    def variable(self, index: int, subindex: int) -> ODVariable | None:
        """The dictionary's entry, None when the EDS has none."""
        found: ODVariable | None = self.dictionary.get_variable(index, subindex)
        return found

    def answered_again(self, within_s: float) -> bool:
        """Whether a further answer comes to what was answered already: then two nodes have this id."""
        return self._network.wait(lambda: not self._client.responses.empty(), within_s)

    def read(self, index: int, subindex: int = 0) -> int:
        """Upload an integer, signed as the EDS says. Raises Unreachable on time-out, SdoAbort on an abort."""
        data = self.read_bytes(index, subindex)
        if len(data) > _MOST_NUMBER_BYTES:
            raise Unreachable(f"{self._where(index, subindex)}: {len(data)} bytes came where a number stands")
        variable = self.variable(index, subindex)
        signed = variable is not None and variable.data_type in datatypes.SIGNED_TYPES
        if variable is not None and variable.fixed_size and 8 * len(data) < len(variable):
            raise Unreachable(
                f"{self._where(index, subindex)}: {8 * len(data)} bits came, the EDS says {len(variable)}"
            )
        return int.from_bytes(data, "little", signed=signed)

    def read_text(self, index: int, subindex: int = 0) -> str:
        """Upload a visible string; what is not visible in it, and may act on a terminal, becomes a question mark."""
        text = self.read_bytes(index, subindex).rstrip(b"\0").decode("latin-1")
        return "".join(c if c.isprintable() else "?" for c in text)

    def read_bytes(self, index: int, subindex: int = 0) -> bytes:
        """Upload raw data."""
        return bytes(self._transfer(index, subindex, "read", lambda: self._client.upload(index, subindex)))

    def ask(self, index: int, subindex: int) -> bool:
        """Ask for a number without waiting for it; `answer` gives what came.

        False while a transfer is under way, here or on a further connection of this process: a server has one.
        """
        if self._network.shared or not self._lock.acquire(blocking=False):
            return False
        try:
            self._question, self._answer = (index, subindex), None
            self._network.send_message(SDO_REQUEST_BASE + self.node_id, _ASK.pack(_UPLOAD, index, subindex))
        except Unreachable:  # the bus is down, which others tell
            self._question = None
        finally:
            self._lock.release()
        return self._question is not None

    def answer(self) -> SdoAnswer | None:
        """What the node said to `ask`; None before it does."""
        return self._answer

    def _on_answer(self, _can_id: int, data: bytearray, _time_ns: float) -> None:
        question = self._question
        if question is None or len(data) != _FRAME_BYTES or _ASK.unpack_from(data)[1:] != question:
            return
        command, self._question = data[0], None
        if command == _ABORT_COMMAND:
            self._answer = SdoAnswer(None, int.from_bytes(data[4:8], "little"))
        elif command & _EXPEDITED_MASK == _EXPEDITED:
            variable = self.variable(*question)
            signed = variable is not None and variable.data_type in datatypes.SIGNED_TYPES
            size = _FRAME_BYTES - 4 - (command >> 2 & 3 if command & _SIZED else 0)
            if variable is not None and variable.fixed_size:  # as an upload does: devices are known that fill up
                size = min(size, len(variable) // 8)
            self._answer = SdoAnswer(int.from_bytes(data[4 : 4 + size], "little", signed=signed), 0)

    def write(self, index: int, subindex: int, value: int) -> None:
        """Download an integer with the length that the EDS gives.

        Raises Unreachable, SdoAbort (also when the EDS has no such object), BadInput when the value does not fit.
        """
        variable = self.variable(index, subindex)
        if variable is None:
            raise SdoAbort(f"{self._where(index, subindex)}: the EDS has no such object", int(Abort.NO_SUCH_OBJECT))
        size = len(variable) // 8
        try:
            data = value.to_bytes(size, "little", signed=variable.data_type in datatypes.SIGNED_TYPES)
        except OverflowError:
            raise BadInput(self._where(index, subindex), value, f"a value of {8 * size} bits") from None
        self._transfer(index, subindex, "write", lambda: self._client.download(index, subindex, data))

    def _transfer(self, index: int, subindex: int, verb: str, transfer: Any) -> Any:
        with self._lock:
            if self._question is not None:  # its answer would be taken for ours
                self._network.wait(lambda: self._question is None, _ASKED_S)
                self._question = None
            self._network.drain()  # an answer that came too late must not be taken for the next one
            self._client.begin(index, subindex)
            try:
                return transfer()
            except SdoAbortedError as abort:
                text = f"{self._where(index, subindex)}: {verb} refused, 0x{abort.code:08X} {abort_text(abort.code)}"
                raise SdoAbort(text, abort.code) from None
            except SdoCommunicationError as error:
                raise SdoNoAnswer(f"{self._where(index, subindex)}: {verb} failed, {error}") from None

    def _where(self, index: int, subindex: int) -> str:
        return f"node {self.node_id} object 0x{index:04X}:{subindex}"
