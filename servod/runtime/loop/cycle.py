"""One cycle of the loop, in the order in which it happens:

    SYNC -> frames -> feedback in SI units -> axis: state, goal -> controller: torque -> limits: last word
         -> control word and torque in one PDO -> heartbeat -> record -> at most one command from the supervisor

A synchronous RPDO acts at the next SYNC: one cycle of delay belongs to the loop by design.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from servod.common.clock import Clock
from servod.common.faults import FAULTS, FaultCode
from servod.common.units import NS_PER_S, NS_PER_US
from servod.formats.config_wire import quick_stop_stays
from servod.kernels.motions import Samples
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.devices import AmplifierCommand, AmplifierFeedback, EncoderFeedback, Goal, Mode
from servod.runtime.fieldbus.registry import amplifier_of, encoder_of
from servod.runtime.loop.axis import Axis, AxisOutput
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.brake import BrakeTimes, rest_rad
from servod.runtime.loop.commands import Command
from servod.runtime.loop.controller import Controller
from servod.runtime.loop.exchange import Exchange
from servod.runtime.loop.limits import Limits
from servod.runtime.loop.orders import Orders
from servod.runtime.loop.oscillation import Oscillation
from servod.runtime.loop.plan import LoopPlan
from servod.runtime.loop.references import Reference
from servod.runtime.loop.wiring.checks import wiring_test_bounds
from servod.runtime.loop.wiring.findings import WiringReport
from servod.runtime.loop.wiring.wiring_test import WiringTest

_SUPERVISOR_LOST = FAULTS[FaultCode.SUPERVISOR_LOST].bit
_NOT_PROVEN = FAULTS[FaultCode.WIRING_NOT_PROVEN].bit
_OSCILLATES = FAULTS[FaultCode.OSCILLATES].bit
#: At a shutdown the drive must be seen without power for so many cycles, and has so many to get there.
GOODBYE_CYCLES = 20
GOODBYE_TIMEOUT_S = 1.0
#: How long a drive that is withdrawn from stays in NMT stopped before it is asked to be pre-operational, and after how
#: long it answers SDO again.
_STOPPED_CYCLES = 5
ANSWERS_AGAIN_CYCLES = _STOPPED_CYCLES + 2


class LoopPort(Protocol):
    """The loop's side of its supervisor: shared memory in a process of its own, plain lists when stepped."""

    @property
    def trajectory(self) -> Samples:
        """Positions that a table motion reads."""
        ...

    def write_record(self, values: Sequence[float]) -> None:
        """Publish one cycle record."""
        ...

    def next_command(self) -> Command | None:
        """The next command, or None."""
        ...

    def write_proof(self, proof: WiringReport) -> None:
        """Publish how a test of the wiring ended."""
        ...


class _Torque(NamedTuple):
    """Torque of one cycle and its parts, N*m; `limited` is what the limits let through."""

    limited: float = 0.0
    controller: float = 0.0
    feedback: float = 0.0
    friction: float = 0.0
    other: float = 0.0


_NO_TORQUE = _Torque()


class Cycle:
    """Everything that one cycle touches. `finished` turns true when a shutdown is complete."""

    def __init__(
        self, plan: LoopPlan, bus: Bus, clock: Clock, link: LoopPort, supervisor_alive: Callable[[], bool]
    ) -> None:
        """Build the cycle of `plan` on `bus`; all configuration is copied into plain values here."""
        config = plan.config
        self.clock, self.link, self._supervisor_alive = clock, link, supervisor_alive
        self.period_ns = config.cycle.period_us * NS_PER_US
        self._period_s = self.period_ns / NS_PER_S
        self._feedback_timeout_ns = config.cycle.feedback_timeout_us * NS_PER_US
        self.amplifier = amplifier_of(plan.amplifier)
        self.encoder = encoder_of(plan.encoder)
        self.exchange = Exchange(bus, clock, self.amplifier, self.encoder, plan)
        self.axis = Axis(
            self._period_s, config.limits.ramp_down_s, config.amplifier.enable_timeout_s, Mode.CYCLIC_SYNC_TORQUE,
            config.wiring_proof.timeout_s, config.amplifier.inputs.reports_sto,
            BrakeTimes.of(config.amplifier), config.limits.stale_cycles,
            rest_rad(config.amplifier) if quick_stop_stays(config.amplifier.quick_stop_option) else None,
        )  # fmt: skip
        self.axis.carry(plan.carried)
        self.limits = Limits(config.limits, plan.stop)
        self._limit_nm = self.limits.torque_nm
        self.oscillation = Oscillation(config.limits.oscillation_nm)
        self._drive_limit_nm = float(plan.amplifier.facts.get("most_torque_nm", self._limit_nm))
        bounds = wiring_test_bounds(config, plan.amplifier.facts)
        self.proof, self._proof_travel_rad = WiringTest(bounds), bounds.most_travel_rad
        self.controller = Controller()
        self.controller.activate(plan.law, plan.parameters, 0.0)
        self.reference = Reference(config.limits.ramp_down_s)
        self.orders = Orders(
            self.axis, self.reference, self.controller, self.limits, self.proof, config.wiring_proof.enabled,
            link.trajectory, self._period_s, plan.serial, self.shut_down,
        )  # fmt: skip
        self._judged_serial = plan.serial
        self.shutting_down = self.finished = self.seen_off = False
        self.torque_nm = self.encoder_position_rad = 0.0
        self._ramp_from_nm = 0.0
        self._opening = False  # before the test of the wiring the brake opens
        self._heartbeat_every = max(
            _STOPPED_CYCLES + 1, config.heartbeat.master_period_ms * 1000 // config.cycle.period_us
        )
        self._number = self._missed = self._heartbeat_due = 0
        self._last_sync_ns = self.exchange.sync_ns - self.period_ns
        self._goodbye_cycles = max(2 * GOODBYE_CYCLES, round(GOODBYE_TIMEOUT_S / self._period_s))
        self._command_seq = self._command_result = 0
        self._tick_ns = self._torque_sent_ns = self._goodbye = self._resting = self._withdrawn = 0

    def stand_still(self, periods: int) -> None:
        """So many periods went by without a cycle, in virtual time, and nobody was late."""
        self._number += periods
        self._missed += periods

    def step(self, deadline_ns: int, woke_ns: int, skipped: int) -> None:
        """One cycle; `skipped` periods were missed before it."""
        self._number += 1 + skipped
        self._missed += skipped
        sync_ns = self.exchange.sync()
        waiting_from_ns = self.clock.now_ns()
        self.exchange.collect(sync_ns + self._feedback_timeout_ns)
        waited_ns = self.clock.now_ns() - waiting_from_ns
        amplifier, encoder = self.amplifier.read(), self.encoder.read()
        dt_s = self._interval_s(sync_ns)
        self.encoder_position_rad = encoder.position_rad
        self.limits.look(amplifier, encoder, dt_s)
        faults = self._faults(amplifier, encoder, skipped)
        moving = self.limits.moving(encoder)
        output = self.axis.step(amplifier, encoder.age_cycles == 0, faults, self.reference.at_rest, moving)
        torque = self._torque(output, amplifier, encoder, dt_s)
        sent_nm = self._send(torque.limited, output)
        self._torque_sent_ns = self.clock.now_ns() - deadline_ns
        self._record(woke_ns - deadline_ns, amplifier, encoder, torque, sent_nm)
        self._take_command()
        self._say_goodbye(amplifier)
        self._tick_ns = self.clock.now_ns() - woke_ns - waited_ns

    def shut_down(self) -> None:
        """Bring the axis to rest, switch it off, and be finished some cycles later."""
        self.shutting_down = True
        self.axis.disable()

    def _interval_s(self, sync_ns: int) -> float:
        """Measured time since the last SYNC; a long stall is not integrated as if the loop had been there."""
        interval_s = (sync_ns - self._last_sync_ns) / NS_PER_S
        self._last_sync_ns = sync_ns
        return min(max(interval_s, 0.2 * self._period_s), 20.0 * self._period_s)

    def _faults(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback, skipped: int) -> int:
        faults = self.limits.feedback_faults(amplifier, encoder, skipped) | self.exchange.faults()
        faults |= self.orders.event_faults
        self.orders.event_faults = 0
        if self.axis.state.powered:
            followed = self.reference.position_rad if self.axis.state.following else None
            faults |= self.limits.motion_faults(amplifier, encoder, followed)
            if followed is not None:
                faults |= self.limits.torque_faults(amplifier)
        if self.proof.running or self._opening:
            faults |= self.limits.proving_faults(encoder, self._proof_travel_rad)
        if not self._supervisor_alive():
            faults |= _SUPERVISOR_LOST
            self.shutting_down = True
        return faults

    def _torque(
        self, output: AxisOutput, amplifier: AmplifierFeedback, encoder: EncoderFeedback, dt_s: float
    ) -> _Torque:
        """Controller and limits; zero torque when the axis is not controlled."""
        if self.axis.state == AxisState.PROVING:
            return self._prove(amplifier, encoder, dt_s)
        if not output.controlled:
            self._opening = False
            self._rest(encoder)
            return _NO_TORQUE
        if output.just_enabled:
            self._seed(amplifier, encoder)
        if output.brake:
            self.reference.halt(True)
        self.reference.watch(encoder.position_rad)
        self.reference.advance(dt_s)
        reference = self.reference
        law = self.controller.step(
            reference.position_rad, reference.velocity_rad_s, reference.acceleration_rad_s2,
            encoder.position_rad, encoder.velocity_rad_s, self.torque_nm, dt_s, reference.torque_nm,
        )  # fmt: skip
        ramping = self.axis.state == AxisState.RAMPING
        wanted_nm = law.u
        if ramping:
            wanted_nm = self.limits.ramp(self._ramp_from_nm, output.torque_share, encoder.velocity_rad_s)
        sent_nm, faults = self.limits.limit_torque(wanted_nm, dt_s)
        if not ramping:
            self._ramp_from_nm = sent_nm
            if self.orders.controller_serial != self._judged_serial:
                self._judged_serial = self.orders.controller_serial
                self.oscillation.begin(reference.position_rad, self.limits.at_rest_nm)
            swings = self.oscillation.look(
                sent_nm, reference.position_rad, reference.velocity_rad_s, dt_s, reference.torque_nm
            )
            faults |= _OSCILLATES if swings else 0
        if faults:
            self.axis.raise_fault(faults)
        self.torque_nm = sent_nm
        return _Torque(sent_nm, law.u, law.feedback, law.friction, law.other)

    def _prove(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback, dt_s: float) -> _Torque:
        """In place of the controller, before the first torque: the bounded test of the wiring."""
        proof = self.proof
        if not self.axis.brake_open:  # what moves a joint without torque meanwhile, ends it (proving_faults)
            if not self._opening:
                self.limits.arm(amplifier, encoder, 0.0)
            self._opening = True
            self._rest(encoder)
            return _NO_TORQUE
        self._opening = False
        if not proof.running and proof.verdict is None:
            self.limits.torque_nm = self._limit_nm  # the drive's own limit rests on a scale that is not proven yet
            self.limits.arm(amplifier, encoder, 0.0)
            self.reference.hold(encoder.position_rad)
            proof.begin(encoder.position_rad, amplifier.position_rad)
        wanted_nm = proof.step(amplifier, encoder, self.torque_nm, dt_s)
        if proof.verdict is not None:
            self._finish_proof()
        self.torque_nm, faults = self.limits.limit_torque(wanted_nm, dt_s)
        if faults:
            self.axis.raise_fault(faults)
        return _Torque(self.torque_nm, wanted_nm, 0.0, 0.0, wanted_nm)

    def _finish_proof(self) -> None:
        """Tell the answer; the axis goes on to be enabled, or is switched off at once."""
        self.link.write_proof(self.proof.report())
        if self.proof.proven:
            self.axis.proven()
        elif self.axis.state == AxisState.PROVING:
            self.axis.raise_fault(_NOT_PROVEN)

    def _seed(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback) -> None:
        """First controlled cycle: stay where the joint is, go on from the torque that the drive was told last."""
        self.limits.torque_nm = self._drive_limit_nm  # more would be clipped there, unseen by the law
        self.limits.arm(amplifier, encoder, self.torque_nm)
        self.oscillation.begin(encoder.position_rad, self.limits.at_rest_nm)
        self._ramp_from_nm = self.torque_nm
        self.reference.hold(encoder.position_rad)
        self.controller.reset(self.torque_nm)

    def _rest(self, encoder: EncoderFeedback) -> None:
        """Not controlled: the reference follows the joint, torque and ramps start from zero next time."""
        if self.proof.running:  # the axis was switched off meanwhile
            self.proof.interrupt()
            self._finish_proof()
        self.reference.hold(encoder.position_rad)
        self.limits.release()
        self.torque_nm = self._ramp_from_nm = 0.0

    def _send(self, wanted_nm: float, output: AxisOutput) -> float:
        """Control word and torque in one frame; the goal is asked again, since the limits may just have changed it.

        The torque that went out: none unless the axis is to be enabled.
        """
        goal = self.axis.goal
        torque_nm = wanted_nm if goal == Goal.ENABLED else 0.0
        command = AmplifierCommand(goal, torque_nm, False, output.reset_fault, self.axis.release_brake)
        self.exchange.send(*self.amplifier.write(command))
        if self.axis.unheard:
            self._withdraw()
        elif self._number >= self._heartbeat_due:
            self._heartbeat_due = self._number + self._heartbeat_every
            self.exchange.heartbeat()
        return torque_nm

    def _withdraw(self) -> None:
        """The control word does not stop the drive: NMT shall, whose identifier is another and which needs no SYNC, and
        so shall its own consumer (0x1016), which misses our heartbeat from now on. NMT stop is what 0x6007 reacts to
        (CiA 402-2); in pre-operational, a few cycles later, the drive answers SDO again.
        """
        if self._withdrawn == 0:
            self.exchange.stop_drive()
        elif self._withdrawn % self._heartbeat_every == _STOPPED_CYCLES:
            self.exchange.make_drive_answer()
        self._withdrawn += 1

    def _record(
        self, lag_ns: int, amplifier: AmplifierFeedback, encoder: EncoderFeedback, torque: _Torque, sent_nm: float
    ) -> None:
        """Publish the cycle, in the order of servod.formats.recording.record.FIELDS; `sent_nm` is the torque that
        went out."""
        axis, reference, controller = self.axis, self.reference, self.controller
        queue_full, error_frames = self.exchange.counts()
        self.link.write_record((
            self.exchange.sync_ns, self._number, self._missed, lag_ns, self._tick_ns, self._torque_sent_ns,
            axis.state, amplifier.state, amplifier.status_word, amplifier.mode, axis.goal, amplifier.goal_reached,
            amplifier.reasons, axis.faults, axis.latched, amplifier.error_code,
            amplifier.age_cycles, encoder.age_cycles,
            self.orders.controller_serial, self._command_seq, self._command_result,
            reference.active, queue_full, error_frames,
            self.exchange.late_frames, self.amplifier.ignored_frames + self.encoder.ignored_frames,
            reference.position_rad, reference.velocity_rad_s, encoder.position_rad, encoder.velocity_rad_s,
            amplifier.position_rad, amplifier.torque_nm,
            sent_nm, torque.controller, torque.feedback, torque.friction, torque.other,
            controller.friction_state, controller.disturbance,
        ))  # fmt: skip

    def _take_command(self) -> None:
        command = self.link.next_command()
        if command is not None:
            self._command_result = self.orders.carry_out(command, self.encoder_position_rad, self.torque_nm)
            self._command_seq = command.seq

    def _say_goodbye(self, amplifier: AmplifierFeedback) -> None:
        """After a shutdown: finished once the drive was seen without power for some cycles, or has had its time."""
        if not self.shutting_down:
            return
        self.axis.disable()
        if not self.axis.state.stopped:
            return
        self._resting += 1
        if amplifier.age_cycles == 0:  # a cycle without an answer says nothing, neither good nor bad
            self._goodbye = self._goodbye + 1 if amplifier.state.off else 0
        self.seen_off = self._goodbye >= GOODBYE_CYCLES
        self.finished = self.seen_off or self._resting >= self._goodbye_cycles

    def let_go(self) -> None:
        """Last frame of a loop that ends in an error: the drive's quick stop, without waiting for an answer.

        Voltage off would let the joint coast; the supervisor switches off when it rests, or the drive's guards act.
        """
        self.exchange.send_last(*self.amplifier.write(AmplifierCommand(Goal.QUICK_STOP, 0.0)))
