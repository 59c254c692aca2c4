"""Both nodes of the axis as the supervisor deals with them: what they do, switching off, standing down.

Around the loop, on top of the master.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence

from servod.common.errors import ServodError, Unreachable
from servod.common.faults import FAULTS, FaultCode
from servod.common.units import NS_PER_S, TWO_PI
from servod.formats.model.identified import Devices
from servod.runtime.daemon.guard_test import GuardTestStatus, guard_test_status, read_record, terms
from servod.runtime.daemon.status import Age, GuardStatus, IdentityStatus, NodeStatus
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.cia import (
    CW_DISABLE_VOLTAGE,
    CW_QUICK_STOP,
    NmtCommand,
    NmtState,
    Obj402,
    decode_status_word,
)
from servod.runtime.fieldbus.devices import DriveState, NodePlan
from servod.runtime.fieldbus.master import BringUp, Master
from servod.runtime.fieldbus.master.monitor import MASTER_MISSED, NodeEvent
from servod.runtime.loop.brake import rest_rad
from servod.runtime.loop.commands import Op
from servod.runtime.loop.cycle import ANSWERS_AGAIN_CYCLES

log = logging.getLogger("servod")

#: A joint that is stopped by SDO is at rest within `rest_rad` for this time.
_REST_NS = 20_000_000
_NMT_NAMES = {int(state): state.name for state in NmtState}


class Nodes:
    """Amplifier and encoder, brought up."""

    def __init__(self, master: Master, plans: BringUp) -> None:
        self._master, self.plans = master, plans
        # Once, before the rounds begin, which wait for no disk: the test runs while no daemon does.
        self._proof = read_record(master.config)
        proof = self.proof()
        if proof["asked_for"] and not proof["holds"]:
            log.warning("%s: run `servoctl guard-test` while no daemon runs; until then no enabling", proof["text"])

    def look_for_foreign_traffic(self, loop_began_ns: Callable[[], int | None]) -> None:
        """Until the loop listens: raises Unreachable where somebody else commands or asks the nodes."""
        self._master.look_for_foreign_traffic(loop_began_ns)

    def hand_over(self) -> None:
        """The loop listens from now on."""
        self._master.hand_over()

    def events(self) -> list[NodeEvent]:
        """Listen, and give what the nodes did since the last call."""
        self._master.poll()
        return self._master.events()

    def quick_stop(self) -> bool:
        """The drive brakes by its own quick stop, told by SDO; whether it took that."""
        try:
            self._master.sdo(self.plans.amplifier.node_id).write(Obj402.CONTROL_WORD, 0, CW_QUICK_STOP)
        except (ServodError, OSError) as error:
            log.error("the amplifier did not take a quick stop: %s", error)
            return False
        return True

    def brake_to_rest(self, timeout_s: float) -> None:
        """Quick stop by SDO, until the joint rests or there is no torque any more, at the longest for `timeout_s`.

        Then the holding brake, where servod sequences one, has its time to close while the drive still holds.
        """
        plan, amplifier = self.plans.amplifier, self._master.config.amplifier
        sdo, clock = self._master.sdo(plan.node_id), self._master.clock
        moves_counts = rest_rad(amplifier) * amplifier.counts_per_turn * amplifier.gear_ratio / TWO_PI
        until_ns = clock.now_ns() + round(timeout_s * NS_PER_S)
        taken, obeys_ns = self.quick_stop(), clock.now_ns() + _REST_NS
        anchor, since_ns = math.inf, clock.now_ns()
        try:
            while taken and (now_ns := clock.now_ns()) < until_ns and now_ns - since_ns < _REST_NS:
                state = decode_status_word(sdo.read(Obj402.STATUS_WORD))
                if state.unpowered:
                    return
                if state is DriveState.OPERATION_ENABLED and now_ns > obeys_ns:  # it will not brake
                    break
                position = sdo.read(Obj402.POSITION_ACTUAL)
                if not abs(position - anchor) <= moves_counts:
                    anchor, since_ns = position, clock.now_ns()
        except (ServodError, OSError) as error:
            log.error("the amplifier does not tell of its stop: %s", error)
        if self._close_brake():  # also of a drive that answered nothing: one lost answer must not drop the load
            self._master.pause(amplifier.brake.engage_s)

    def stop_past_loop(self) -> None:
        """Brake to rest, close the brake, voltage off, all by SDO: a loop that stands still may wake, and NMT of ours
        would be a second master's to it."""
        self.brake_to_rest(self._master.config.amplifier.enable_timeout_s)
        self._voltage_off()

    def misses_loop(self, event: NodeEvent) -> bool:
        """The drive tells that it does not hear the loop any more, and so stops by itself or is to be stopped."""
        return event.node_id == self.plans.amplifier.node_id and event.code in MASTER_MISSED

    def stop_axis(self) -> None:
        """Without the loop, or past it: brake to rest, close the brake, and only then switch off. Voltage off at once
        would let the joint coast, and a load fall."""
        self.brake_to_rest(self._master.config.amplifier.enable_timeout_s)
        self.switch_off()

    def stop_withdrawn(self) -> None:
        """`stop_axis` for a drive that the loop withdraws from: NMT stopped answers no SDO, and the loop ends it some
        cycles later. Asked twice, for the drive may take a while for that."""
        self._master.pause(ANSWERS_AGAIN_CYCLES * self._master.config.cycle.period_us * 1e-6)
        self.quick_stop()
        self.stop_axis()

    def switch_off(self) -> None:
        """Voltage off by SDO, brake closed, then NMT pre-operational; each is tried whatever became of the others."""
        self._voltage_off()
        for plan in (self.plans.amplifier, self.plans.encoder):
            try:
                self._master.nmt(NmtCommand.PRE_OPERATIONAL, plan.node_id)
            except (ServodError, OSError) as error:
                log.error("node %d: NMT pre-operational failed: %s", plan.node_id, error)

    def _voltage_off(self) -> None:
        try:
            self._master.sdo(self.plans.amplifier.node_id).write(Obj402.CONTROL_WORD, 0, CW_DISABLE_VOLTAGE)
        except (ServodError, OSError) as error:
            log.error("the amplifier did not take disable voltage: %s", error)
        self._close_brake()

    def _close_brake(self) -> bool:
        """By SDO, where servod sequences it; whether it does. One that is not answered may have closed all the same."""
        plan = self.plans.amplifier
        if brake := plan.facts.get("brake"):
            try:
                self._master.sdo(plan.node_id).write(Obj402.DIGITAL_OUTPUTS, 1, brake[0])
            except (ServodError, OSError) as error:
                log.error("the amplifier did not close the brake: %s", error)
        return bool(brake)

    def stand_down(self) -> None:
        """Orderly end. The drive forgets the master's heartbeat, so this is only for a drive that was seen off."""
        try:
            self._master.stand_down()
        except (ServodError, OSError) as error:
            log.warning("nodes did not stand down in order: %s", error)

    def of_ours(self, bus: Bus) -> Bus:
        """A further connection of the daemon, which the watch over the nodes does not take for somebody else's."""
        return self._master.of_ours(bus)

    def proof(self) -> GuardTestStatus:
        """Whether the guards of this drive are proven."""
        amplifier = self.plans.amplifier
        found = terms(amplifier, self._master.identity(amplifier.node_id))
        return guard_test_status(self._master.config, self._proof, found, time.time())

    def guards(self) -> GuardStatus:
        """How the drive guards itself, for the status document."""
        facts = self.plans.amplifier.facts
        return {
            "unguarded": bool(facts.get("unguarded", False)),
            "reaction_ms": int(facts["reaction_ms"]),
            "command_deadline_ms": int(facts["command_deadline_ms"]),
            "heartbeat_timeout_ms": int(facts["heartbeat_timeout_ms"]),
            "most_torque_nm": facts.get("most_torque_nm"),
            "watched": len(facts.get("guards", ())),
            "proof": self.proof(),
        }

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
            for role, plan in self._roles()
        ]

    def devices(self) -> Devices:
        """What drive and encoder said of themselves at the start."""
        return Devices.of({role: self._identity(plan.node_id) for role, plan in self._roles()})

    def _roles(self) -> tuple[tuple[str, NodePlan], ...]:
        return ("amplifier", self.plans.amplifier), ("encoder", self.plans.encoder)

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

    @property
    def waiting(self) -> int:
        """What the loop was not told yet, as fault bits."""
        return sum(FAULTS[fault].bit for fault in self._waiting)

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
