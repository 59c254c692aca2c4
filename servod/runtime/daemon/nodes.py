"""Both nodes of the axis as the supervisor deals with them: what they do, switching off, standing down.

Around the loop, on top of the master.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from servod.common.errors import ServodError, Unreachable
from servod.common.faults import FaultCode
from servod.runtime.daemon.status import Age, IdentityStatus, NodeStatus
from servod.runtime.fieldbus.cia import CW_DISABLE_VOLTAGE, NmtCommand, NmtState, Obj402
from servod.runtime.fieldbus.master import BringUp, Master
from servod.runtime.fieldbus.master.monitor import NodeEvent
from servod.runtime.loop.commands import Op

log = logging.getLogger("servod")

_NMT_NAMES = {int(state): state.name for state in NmtState}


class Nodes:
    """Amplifier and encoder, brought up."""

    def __init__(self, master: Master, plans: BringUp) -> None:
        self._master, self.plans = master, plans

    def events(self) -> list[NodeEvent]:
        """Listen, and give what the nodes did since the last call."""
        self._master.poll()
        return self._master.events()

    def switch_off(self) -> None:
        """Voltage off by SDO, then NMT pre-operational; each is tried whatever became of the other."""
        amplifier = self.plans.amplifier.node_id
        try:
            self._master.sdo(amplifier).write(Obj402.CONTROL_WORD, 0, CW_DISABLE_VOLTAGE)
        except (ServodError, OSError) as error:
            log.error("the amplifier did not take disable voltage: %s", error)
        for plan in (self.plans.amplifier, self.plans.encoder):
            try:
                self._master.nmt(NmtCommand.PRE_OPERATIONAL, plan.node_id)
            except (ServodError, OSError) as error:
                log.error("node %d: NMT pre-operational failed: %s", plan.node_id, error)

    def stand_down(self) -> None:
        """Orderly end. The drive forgets the master's heartbeat, so this is only for a drive that was seen off."""
        try:
            self._master.stand_down()
        except (ServodError, OSError) as error:
            log.warning("nodes did not stand down in order: %s", error)

    def status(self) -> list[NodeStatus]:
        """The part of the status document."""
        return [
            {
                "node_id": plan.node_id,
                "role": role,
                "driver": plan.driver,
                "state": self._state(plan.node_id),
                "identity": self._identity(plan.node_id),
                **self._age(plan.node_id),
            }
            for role, plan in (("amplifier", self.plans.amplifier), ("encoder", self.plans.encoder))
        ]

    def _identity(self, node_id: int) -> IdentityStatus | None:
        found = self._master.identity(node_id)
        if found is None:
            return None
        return {
            "vendor_id": found.vendor_id,
            "product_code": found.product_code,
            "revision": found.revision,
            "serial": found.serial,
        }

    def _age(self, node_id: int) -> Age:
        age_s = self._master.heartbeat_age_s(node_id)
        return {"age_s": age_s, "stale": age_s is None or age_s > self._master.heartbeat_limit_s(node_id)}

    def _state(self, node_id: int) -> str:
        name = nmt_name(self._master.nmt_state(node_id))
        return f"silent (was {name})" if self._master.silent(node_id) else name


class FaultRelay:
    """Node faults on their way to the loop; what its queue does not take now waits for the next round."""

    def __init__(self, send: Callable[[Op, Sequence[float]], int]) -> None:
        self._send = send
        self._waiting: dict[FaultCode, None] = {}  # an ordered set

    def add(self, fault: FaultCode) -> None:
        """One more for the loop; one that still waits is not sent twice."""
        self._waiting[fault] = None

    def flush(self) -> None:
        """Send what the queue takes, oldest first."""
        try:
            for fault in list(self._waiting):
                self._send(Op.NODE_EVENT, (float(fault),))
                del self._waiting[fault]
        except Unreachable:
            return


def nmt_name(state: int | None) -> str:
    """Name of an NMT state; nodes may send any number."""
    return "not heard yet" if state is None else _NMT_NAMES.get(state, f"unknown state {state}")
