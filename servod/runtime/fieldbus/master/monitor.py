"""Watches the nodes of an axis: heartbeats that stop, boot-up where there should be none, EMCY. Off the control path.

Everything seen becomes a NodeEvent that names a row of the fault table; the supervisor hands it to the loop.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass

from canopen.emcy import EmcyError

from servod.common.faults import FaultCode
from servod.common.units import NS_PER_S
from servod.runtime.fieldbus.cia import EMCY_BASE, HEARTBEAT_BASE, NmtState
from servod.runtime.fieldbus.master.network import BusNetwork

_EMCY = struct.Struct("<HB5s")
_TOGGLE_MASK = 0x7F
#: States after operational that a node only reaches by NMT; a number that is none is shown, and is no state.
_LEFT = (NmtState.STOPPED, NmtState.PRE_OPERATIONAL)
#: More waiting events than this means that nobody reads them; the oldest are dropped then.
_MAX_EVENTS = 1000


@dataclass(frozen=True, slots=True)
class NodeEvent:
    """Something a node did that the axis must know of; `code` is the EMCY code or the NMT state, as the fault says."""

    time_ns: int
    node_id: int
    fault: FaultCode
    text: str
    code: int


class NodeWatch:
    """Heartbeat consumer and EMCY consumer for one node."""

    def __init__(self, network: BusNetwork, node_id: int, emcy_fault: FaultCode, timeout_ms: int) -> None:
        self.node_id = node_id
        self.nmt_state: int | None = None  # not heard yet
        self.boot_ups = 0
        self.events: deque[NodeEvent] = deque(maxlen=_MAX_EVENTS)
        self._clock = network.clock
        self._emcy_fault = emcy_fault
        self._timeout_ns = timeout_ms * 1_000_000
        self._heard_ns: int | None = None  # the watch began, or a heartbeat came
        self._heartbeat_ns: int | None = None
        self.lost = False  # its heartbeat is missing now
        self._watching = False
        network.subscribe(HEARTBEAT_BASE + node_id, self._on_heartbeat)
        network.subscribe(EMCY_BASE + node_id, self._on_emcy)

    def watch(self, on: bool) -> None:
        """Start or end the supervision: only then a boot-up, a stop of heartbeats or another state is an event."""
        self._heard_ns, self.lost, self._watching = self._clock.now_ns(), False, on

    @property
    def limit_s(self) -> float:
        """A heartbeat older than this is missing."""
        return self._timeout_ns / NS_PER_S

    def heartbeat_age_s(self) -> float | None:
        """How long ago the last heartbeat came, in s; None before the first."""
        return None if self._heartbeat_ns is None else (self._clock.now_ns() - self._heartbeat_ns) / NS_PER_S

    def check(self) -> None:
        """Raise an event when the heartbeat has been missing for its time; once for each loss."""
        if not self._watching or self.lost or self._heard_ns is None:
            return
        silent_ns = self._clock.now_ns() - self._heard_ns
        if silent_ns > self._timeout_ns:
            self.lost = True
            text = f"node {self.node_id}: no heartbeat for {silent_ns / 1e6:.0f} ms"
            self._add(FaultCode.NODE_HEARTBEAT_LOST, text, 0)

    def _on_heartbeat(self, _can_id: int, data: bytearray, _time_ns: float) -> None:
        if not data:
            return
        state = data[0] & _TOGGLE_MASK
        previous, self.nmt_state = self.nmt_state, state
        self._heard_ns = self._heartbeat_ns = self._clock.now_ns()
        self.lost = False
        if state == NmtState.BOOT_UP:
            self.boot_ups += 1
        if not self._watching:
            return
        if state == NmtState.BOOT_UP:
            self._add(FaultCode.DRIVE_RESET, f"node {self.node_id}: boot-up while it should be operational", state)
        elif state in _LEFT and previous == NmtState.OPERATIONAL:
            text = f"node {self.node_id}: left NMT operational (state {state})"
            self._add(FaultCode.NODE_LEFT_OPERATIONAL, text, state)

    def _on_emcy(self, _can_id: int, data: bytearray, time_ns: float) -> None:
        if len(data) < _EMCY.size:
            return
        code, register, maker = _EMCY.unpack_from(data)
        if code & 0xFF00 == 0:  # error reset, or no error any more
            return
        meaning = EmcyError(code, register, maker, time_ns).get_desc()
        text = f"node {self.node_id}: EMCY 0x{code:04X} {meaning}, register 0x{register:02X}, {maker.hex(' ')}"
        self._add(self._emcy_fault, text, code)

    def _add(self, fault: FaultCode, text: str, code: int) -> None:
        self.events.append(NodeEvent(self._clock.now_ns(), self.node_id, fault, text, code))
