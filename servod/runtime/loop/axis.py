"""The axis: from what is wanted and what the drive says to a goal for the drive and a share of torque, each cycle.

Stands between drivers and controller on the data path. It enables only on an explicit request, turns each fault into
its reaction (servod.common.faults.FAULTS), and brings the axis to rest by one of three ways: braking the reference and
then ramping the torque down (DISABLE, SHUTDOWN, a lost supervisor), the drive's quick stop, or voltage off at once.
"""

from __future__ import annotations

from typing import NamedTuple

from servod.common.faults import FAULTS, NEEDS_RESTART, FaultCode, Reaction
from servod.runtime.fieldbus.devices import (
    HANDSHAKE_SYNCS,
    AmplifierFeedback,
    DriveInput,
    DriveState,
    Goal,
    Mode,
    Reason,
)
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.brake import BrakeTimes, HoldingBrake, RestWatch
from servod.runtime.loop.commands import Refusal
from servod.runtime.loop.sto import StoNaming

_BIT = {code: fault.bit for code, fault in FAULTS.items()}
_MASK = {r: sum(f.bit for f in FAULTS.values() if f.reaction == r) for r in Reaction}
_STATUS_WARNING, _STATUS_REMOTE, _STATUS_LIMIT, _STATUS_FOLLOWS = 1 << 7, 1 << 9, 1 << 11, 1 << 12
#: A drive that is enabled and does not follow its command for so many cycles does not get or take it.
_MOST_UNFOLLOWED = 10
_IN_FAULT = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
_UNHEARD_MASK = _BIT[FaultCode.DRIVE_STAYS_POWERED] | _BIT[FaultCode.COMMANDS_LOST]
#: The drive still gives torque by its own sensor: where there is a brake, it holds the load until that is closed.
_HELD_BY_DRIVE = sum(_BIT[c] for c in (FaultCode.ENCODER_ALARM, FaultCode.ENCODER_IMPLAUSIBLE, FaultCode.NOT_FINITE))
#: The drive is not heard, or says that it stops by itself: voltage off would end the ramp that it is on, or begins as
#: soon as it hears again. Of these, what it is told goes on to be a quick stop until that is over.
_RAMP_GOES_ON = _UNHEARD_MASK | sum(
    _BIT[c] for c in (FaultCode.DRIVE_FAULT, FaultCode.DRIVE_LEFT_OPERATION, FaultCode.LOOP_LOST)
)
_OFF_MASK = sum(FAULTS[code].bit for code in NEEDS_RESTART)
#: What is remembered although the axis is off: a restart is needed, or somebody else is on the bus.
_REMEMBERED_MASK = _OFF_MASK | _BIT[FaultCode.SECOND_MASTER] | _BIT[FaultCode.FOREIGN_FEEDBACK]
#: A drive that is told to switch off, or to stop, and is still commanded after this time does not obey; one with a
#: brake of its own may hold until that is closed. One that does not answer either has the handshake alone: without SYNC
#: it takes no command, and the deadline of its commands sees them come all the same.
_OBEY_S = 0.03
#: The test of the wiring ends by itself after its time-out; one that does not is ended so much later.
_PROOF_MARGIN_S = 0.25
_ESTOP, _STO = _BIT[FaultCode.ESTOP_ACTIVE], _BIT[FaultCode.STO_ACTIVE]
#: As plain numbers: `&` with an enumeration's member costs a microsecond, in every cycle.
_IN_ESTOP, _IN_STO, _IN_STO_TOLD = int(DriveInput.ESTOP), int(DriveInput.STO), int(DriveInput.STO_TOLD)
_COMMANDS_MISSED = int(Reason.COMMANDS_MISSED)


class AxisOutput(NamedTuple):
    """What the axis asks for in this cycle, beside the goal."""

    torque_share: float  # 0..1, applied to the controller's torque
    controlled: bool  # the controller runs and its torque goes out
    just_enabled: bool  # first controlled cycle: seed reference, controller and limits
    brake: bool  # let the reference come to rest
    reset_fault: bool  # one rising edge for the drive


class Axis:
    """State of one axis and its faults; `step` once per cycle."""

    def __init__(
        self,
        period_s: float,
        ramp_down_s: float,
        enable_timeout_s: float,
        mode: Mode,
        proof_timeout_s: float,
        sto_known: bool = False,
        brake: BrakeTimes | None = None,
        stale_cycles: int = 5,
        stays_rad: float | None = None,
    ) -> None:
        """Times in seconds; `mode` is what the drive must show while enabled, `sto_known`: something tells of STO.

        `stale_cycles`: a drive that is not heard for so long does not answer; `stays_rad`: it holds in quick stop
        active (0x605A from 5 on) until it is told otherwise, and rests within this angle.
        """
        self.state = AxisState.DISABLED
        self.faults = 0  # present in this cycle
        self.latched = 0  # since the last enable or reset
        self._period_s, self._mode = period_s, int(mode)
        self._ramp_cycles = max(1, round(ramp_down_s / period_s))
        self._timeout_cycles = max(1, round(enable_timeout_s / period_s))
        self._proof_cycles = round((proof_timeout_s + _PROOF_MARGIN_S) / period_s)
        self._cycles_in_state = self._disobeyed_cycles = self._unclocked_cycles = 0
        self._sequenced = brake is not None and brake.by_output
        holds_s = brake.engage_s if brake and not self._sequenced else 0.0
        self._obey_cycles, self._stale_cycles = max(4, round((_OBEY_S + holds_s) / period_s)), stale_cycles
        self._reset_wanted, self._seen_off, self._seen_remote, self._seen_follows = False, True, False, False
        self._unfollowed_cycles = 0
        self._end_state = AxisState.DISABLED
        self._moving = self._stops_on = False
        self._carried = 0
        self._prove = self._proven = False
        self._sto = StoNaming(period_s, sto_known)
        self._inputs = 0  # of this cycle
        self._brake = HoldingBrake(brake, period_s, stale_cycles) if brake else None
        self._rest = RestWatch(period_s, stays_rad) if stays_rad is not None and not self._sequenced else None
        self._torque_on = False  # the drive gives torque, by command
        if self._brake:
            self._proof_cycles += self._brake.open_cycles

    @property
    def goal(self) -> Goal:
        """What the drive shall do in the present state."""
        return Goal.QUICK_STOP if self._stops_on else _GOAL[self.state]

    @property
    def brake_open(self) -> bool:
        """The joint is free: there is no brake, or it has had its time to open."""
        waits = self._brake is not None and self.state is AxisState.PROVING
        return not (waits and self._brake and self._cycles_in_state <= self._brake.open_cycles)

    @property
    def release_brake(self) -> bool:
        """What a brake by output is told: open, only ever with torque on."""
        brake, state = self._brake, self.state
        if brake is None or not brake.by_output or not self._torque_on:
            return False
        if state is AxisState.RELEASING:
            return self._cycles_in_state >= brake.torque_first_cycles
        if state is AxisState.QUICK_STOPPING:
            return brake.closing_cycles is None
        return state in (AxisState.PROVING, AxisState.ENABLED, AxisState.BRAKING)

    @property
    def unheard(self) -> bool:
        """The drive does not follow the control word, or does not get it: other ways must stop it."""
        return bool(self.latched & ~self._carried & _UNHEARD_MASK)

    def enable(self, reset_fault: bool, prove: bool = False) -> Refusal:
        """Explicit request to enable; with `reset_fault` latched faults and the drive's fault are reset first.

        With `prove` the drive's power is followed by the state PROVING, which `proven` ends.
        """
        if not self.state.stopped:
            return Refusal.DONE if self.state.under_way else Refusal.MOTION_RUNNING
        if self.latched & _OFF_MASK & ~self._carried:
            return Refusal.NEEDS_RESTART
        if self._stops_on:  # the drive is on its ramp, which anything else would end
            return Refusal.MOTION_RUNNING
        if self._inputs & (DriveInput.ESTOP | DriveInput.STO):
            return Refusal.ESTOP_ACTIVE if self._inputs & DriveInput.ESTOP else Refusal.STO_ACTIVE
        if self._sto.pending:
            return Refusal.FAULT_PRESENT
        if reset_fault:
            self.reset_fault()
        if self.latched & ~_MASK[Reaction.NONE] & ~_MASK[Reaction.CLIP]:
            return Refusal.FAULT_PRESENT
        self.latched, self._seen_remote, self._seen_follows, self._unfollowed_cycles = 0, False, False, 0
        self._carried = 0
        self._enter(AxisState.ENABLING)
        self._prove, self._proven = prove, False
        return Refusal.DONE

    def proven(self) -> None:
        """The test passed: the axis is enabled in the next cycle."""
        self._proven = True

    def reset_fault(self) -> Refusal:
        """Forget latched faults, but for those that need a restart, and ask the drive once to reset its own."""
        if self.state.powered or self._stops_on:
            return Refusal.MOTION_RUNNING
        self.latched, self._reset_wanted = self.latched & _OFF_MASK & ~self._carried, True
        self._carried = 0
        if self.state == AxisState.FAULT:
            self._enter(AxisState.DISABLED)
        return Refusal.DONE

    def disable(self) -> None:
        """Bring the axis to rest under control, then switch off."""
        if self.state == AxisState.ENABLED:
            self._stop(AxisState.BRAKING, AxisState.DISABLED)
        elif self.state == AxisState.RELEASING:
            self._stop(self._after_braking(), AxisState.DISABLED)
        elif self.state.starting:
            self._enter(AxisState.DISABLED)

    def quick_stop(self) -> None:
        """Let the drive stop the axis by its quick-stop option."""
        if self.state.controlled:
            failed = not self.state.under_way and self._end_state == AxisState.FAULT
            self._stop(AxisState.QUICK_STOPPING, AxisState.FAULT if failed else AxisState.DISABLED)
        elif self.state.starting:
            self._enter(AxisState.DISABLED)

    def carry(self, fault_bits: int) -> None:
        """Faults of before a new bring-up of the nodes, that nobody acknowledged: a reset by hand is enough now."""
        self.latched, self._carried = fault_bits, fault_bits
        if fault_bits:
            self._enter(AxisState.FAULT)

    def note(self, fault_bits: int) -> None:
        """Latch faults that the supervisor saw, also while disabled."""
        self.latched |= fault_bits & ~self._sto.hidden
        self._carried &= ~fault_bits

    def step(
        self, amplifier: AmplifierFeedback, encoder_fresh: bool, faults: int, at_rest: bool, moving: bool = False
    ) -> AxisOutput:
        """One cycle: `faults` are the bits that limits, bus and supervisor raised; returns what to do.

        `encoder_fresh`: the encoder's sample is of this cycle; `at_rest`: the reference stands still; `moving`: the
        joint does not.
        """
        self._moving = moving
        self._cycles_in_state += 1
        self._inputs = amplifier.inputs
        self._unclocked_cycles = 0 if encoder_fresh else self._unclocked_cycles + 1
        if amplifier.age_cycles == 0:
            self._torque_on = amplifier.state.commanded
        found = faults | self._drive_faults(amplifier) | self._input_faults()
        self.faults, late = self._sto.named(found, amplifier.state in _IN_FAULT)
        self.latched |= self.faults & _REMEMBERED_MASK | late
        self._carried &= ~self.faults
        if not self.state.stopped:
            self._react(found, amplifier)
        elif self._stops_on:
            self._watch_stop(amplifier)
        elif self.faults & _UNHEARD_MASK:
            self._enter(AxisState.FAULT)
        just_enabled = self._move_on(amplifier, encoder_fresh, at_rest)
        reset, self._reset_wanted = self._reset_wanted, False
        return AxisOutput(
            self._torque_share(),
            self.state.controlled,
            just_enabled,
            self.state == AxisState.BRAKING,
            reset,
        )

    def raise_fault(self, fault_bits: int) -> None:
        """A fault found after `step` in the same cycle (the torque limits): react at once."""
        self.faults |= fault_bits
        if not self.state.stopped:
            self._react(self.faults, None)

    def _enter(self, state: AxisState) -> None:
        self.state, self._cycles_in_state, self._stops_on = state, 0, False

    def _stop(self, way: AxisState, end: AxisState) -> None:
        """A brake that opens or closes is closed: only of a joint that moved freely it waits for the rest."""
        free = self.state in (AxisState.ENABLED, AxisState.BRAKING)
        self._end_state = end
        self._enter(way)
        if way is AxisState.QUICK_STOPPING and self._brake:
            self._brake.begin_stop(closes=not free)
        if self._rest:
            self._rest.begin()

    def _react(self, faults: int, amplifier: AmplifierFeedback | None) -> None:
        """Apply the strongest reaction among the present faults; a stop in progress is only ever made stronger.

        `amplifier` None: a fault found within the cycle, of which the drive says nothing.
        """
        state = self.state
        self.latched |= self.faults
        if not faults:
            return
        if faults & _MASK[Reaction.DISABLE]:
            if amplifier is not None and self._ramp_goes_on(faults, amplifier):
                self._stop(AxisState.QUICK_STOPPING, AxisState.FAULT)
                self._enter(AxisState.FAULT)
                self._stops_on = True
            elif not self._drive_holds(faults):
                self._enter(AxisState.FAULT)
        elif faults & _MASK[Reaction.QUICK_STOP]:
            if state.starting:
                self._enter(AxisState.FAULT)
            elif state != AxisState.QUICK_STOPPING:
                self._stop(AxisState.QUICK_STOPPING, AxisState.FAULT)
            self._end_state = AxisState.FAULT
        elif faults & _MASK[Reaction.RAMP_DOWN]:
            self._react_ramp_down(faults)

    def _ramp_goes_on(self, faults: int, amplifier: AmplifierFeedback) -> bool:
        """The loop is done with the axis, and the drive shall finish its stop, or begin one when it hears again."""
        others = faults & _MASK[Reaction.DISABLE] & ~_RAMP_GOES_ON
        if others or self.state.starting or not amplifier.state.commanded:
            return False
        # One that hears what it is told, and does not stop, is told to be off.
        return not (faults & _BIT[FaultCode.DRIVE_STAYS_POWERED] and amplifier.age_cycles == 0)

    def _watch_stop(self, amplifier: AmplifierFeedback) -> None:
        """In fault, the drive's stop not over: until it is, until the drive does not obey, or has had its time."""
        disobeys = self.faults & _BIT[FaultCode.DRIVE_STAYS_POWERED] and amplifier.age_cycles == 0
        if disobeys or self._quick_stop_is_over(amplifier) or not amplifier.state.commanded:
            self._enter(AxisState.FAULT)

    def _drive_holds(self, faults: int) -> bool:
        """Rather than let go at once, let the drive stop by its own sensor, and close the brake meanwhile."""
        others = faults & _MASK[Reaction.DISABLE] & ~_HELD_BY_DRIVE
        if self._brake is None or others or not self._torque_on or self.state.starting:
            return False
        if self.state is not AxisState.QUICK_STOPPING:
            self._stop(AxisState.QUICK_STOPPING, AxisState.FAULT)
        self._end_state = AxisState.FAULT
        self._brake.close()
        return True

    def _react_ramp_down(self, faults: int) -> None:
        self._end_state = AxisState.FAULT
        # A lost supervisor leaves a sound controller: brake. Else ramp, or where a load may hang, or the joint would
        # coast on when the torque is gone, let the drive stop.
        sound = faults & _MASK[Reaction.RAMP_DOWN] == _BIT[FaultCode.SUPERVISOR_LOST]
        if self.state.starting:
            self._enter(AxisState.FAULT)
        elif (self._brake or self._moving) and not sound and self.state.following:
            self._stop(AxisState.QUICK_STOPPING, AxisState.FAULT)
        elif self.state == AxisState.RELEASING:
            self._stop(self._after_braking(), AxisState.FAULT)
        elif self.state == AxisState.ENABLED or (self.state == AxisState.BRAKING and not sound):
            self._stop(AxisState.BRAKING if sound else AxisState.RAMPING, AxisState.FAULT)

    def _drive_faults(self, amplifier: AmplifierFeedback) -> int:
        """What the drive's own words say is wrong, as fault bits; stale words say nothing (limits count the age)."""
        faults, state = self._disobedience(amplifier), amplifier.state
        if amplifier.reasons & _COMMANDS_MISSED and state.commanded:  # by EMCY: its PDOs may have ended since
            faults |= _BIT[FaultCode.COMMANDS_LOST]
        if amplifier.age_cycles > 0:
            return faults
        if state in _IN_FAULT and not self._being_reset():
            faults |= _BIT[FaultCode.DRIVE_FAULT]
        if amplifier.status_word & _STATUS_WARNING:
            faults |= _BIT[FaultCode.DRIVE_WARNING]
        if self.state.powered:
            faults |= self._operation_faults(amplifier)
        return faults

    def _input_faults(self) -> int:
        """Emergency stop and STO; that the drive still says STO was it counts as little as its fault while reset."""
        inputs, faults = self._inputs, 0
        if inputs & _IN_ESTOP:
            faults = _ESTOP
        if inputs & _IN_STO or (inputs & _IN_STO_TOLD and not self._being_reset()):
            faults |= _STO
        return faults

    def _disobedience(self, amplifier: AmplifierFeedback) -> int:
        """The drive was told to be off or to stop, and is powered or not heard since: its own guards must act.

        While it quick-stops it may be in quick stop active for as long as its ramp takes.
        """
        heard, powered = amplifier.age_cycles == 0, amplifier.state.commanded
        if self.goal not in (Goal.OFF, Goal.QUICK_STOP):
            self._seen_off, self._disobeyed_cycles = False, 0
            return 0
        self._seen_off = self._seen_off or (heard and not powered)
        stopping = self.goal == Goal.QUICK_STOP and amplifier.state == DriveState.QUICK_STOP_ACTIVE
        disobeys = powered and not stopping if heard else not self._seen_off
        answers = amplifier.age_cycles < self._stale_cycles
        # The encoder answers, so SYNC lives, and the drive may stop unheard: NMT would leave its brake open meanwhile.
        closes = self._sequenced and self.state is AxisState.QUICK_STOPPING
        waits = closes and not answers and self._unclocked_cycles < self._stale_cycles
        self._disobeyed_cycles = self._disobeyed_cycles + 1 if disobeys and not waits else 0
        most_cycles = self._obey_cycles if answers else HANDSHAKE_SYNCS
        return _BIT[FaultCode.DRIVE_STAYS_POWERED] if self._disobeyed_cycles > most_cycles else 0

    def _operation_faults(self, amplifier: AmplifierFeedback) -> int:
        state = amplifier.state
        if state == DriveState.UNKNOWN:
            return _BIT[FaultCode.DRIVE_STATUS_UNKNOWN]
        faults = 0
        if state is not DriveState.OPERATION_ENABLED and state not in _IN_FAULT:
            faults |= _BIT[FaultCode.DRIVE_LEFT_OPERATION]
        if amplifier.mode not in (-1, self._mode):
            faults |= _BIT[FaultCode.DRIVE_MODE_WRONG]
        if amplifier.status_word & _STATUS_LIMIT:
            faults |= _BIT[FaultCode.DRIVE_LIMITS_TORQUE]
        if amplifier.status_word & _STATUS_REMOTE:  # some drives never show it, so only its end says something
            self._seen_remote = True
        elif self._seen_remote:
            faults |= _BIT[FaultCode.COMMANDS_LOST]
        if self._ignores_commands(amplifier):
            faults |= _BIT[FaultCode.COMMANDS_LOST]
        return faults

    def _ignores_commands(self, amplifier: AmplifierFeedback) -> bool:
        """Bit 12 of the cyclic modes went off; a drive that limits its torque may do so, and some never show it."""
        word = amplifier.status_word
        if word & (_STATUS_FOLLOWS | _STATUS_LIMIT) or amplifier.state != DriveState.OPERATION_ENABLED:
            self._seen_follows = self._seen_follows or bool(word & _STATUS_FOLLOWS)
            self._unfollowed_cycles = 0
        else:
            self._unfollowed_cycles += 1
        return self._seen_follows and self._unfollowed_cycles > _MOST_UNFOLLOWED

    def _being_reset(self) -> bool:
        """While enabling, the drive may still be in the fault that was just reset; the time-out judges."""
        return self.state == AxisState.ENABLING

    def _move_on(self, amplifier: AmplifierFeedback, encoder_fresh: bool, at_rest: bool) -> bool:
        """Transitions that come with time and the drive's answer; True in the first controlled cycle."""
        state = self.state
        if state == AxisState.ENABLING:
            return self._finish_enabling(amplifier, encoder_fresh)
        if state == AxisState.PROVING:
            return self._finish_proving()
        if state == AxisState.RELEASING and self._brake and self._cycles_in_state > self._brake.open_cycles:
            self._enter(AxisState.ENABLED)
        if state == AxisState.BRAKING and ((at_rest and not self._moving) or self._cycles_in_state > self._ramp_cycles):
            self._stop(self._after_braking(), self._end_state)
        if state == AxisState.ENGAGING and self._brake and self._cycles_in_state > self._brake.engage_cycles:
            self._enter(AxisState.RAMPING)
        if state == AxisState.RAMPING and self._moving:  # a load, or its own way on: without torque it would go on
            self._stop(AxisState.QUICK_STOPPING, self._end_state)
            return False
        ramped = state == AxisState.RAMPING and self._cycles_in_state >= self._ramp_cycles
        if ramped or (state == AxisState.QUICK_STOPPING and self._quick_stop_is_over(amplifier)):
            self._enter(self._end_state)
        return False

    def _after_braking(self) -> AxisState:
        """The torque goes, or stays until the brake is closed: the controller's, or the drive's own that closes it. A
        joint that the controller did not bring to rest with its reference is the drive's to stop: a brake that holds
        is no brake that stops."""
        if self._moving:
            return AxisState.QUICK_STOPPING
        if self._brake is None:
            return AxisState.RAMPING
        return AxisState.ENGAGING if self._brake.by_output else AxisState.QUICK_STOPPING

    def _finish_enabling(self, amplifier: AmplifierFeedback, encoder_fresh: bool) -> bool:
        fresh = encoder_fresh and amplifier.age_cycles == 0
        if fresh and amplifier.goal_reached and amplifier.state == DriveState.OPERATION_ENABLED:
            held = AxisState.RELEASING if self._brake else AxisState.ENABLED
            self._enter(AxisState.PROVING if self._prove else held)
            return not self._prove
        if self._cycles_in_state > self._timeout_cycles:
            fault_code = FaultCode.STO_ACTIVE if amplifier.inputs & DriveInput.STO_TOLD else FaultCode.DRIVE_FAULT
            self._fail(fault_code if amplifier.reasons & Reason.IN_FAULT else FaultCode.ENABLE_TIMEOUT)
        return False

    def _finish_proving(self) -> bool:
        if self._proven:
            self._enter(AxisState.ENABLED)
        elif self._cycles_in_state > self._proof_cycles:
            self._fail(FaultCode.WIRING_NOT_PROVEN)
        return self._proven

    def _fail(self, fault: FaultCode) -> None:
        """What was to be enabled did not get there in its time."""
        self.faults |= _BIT[fault]
        self.latched |= _BIT[fault]
        self._enter(AxisState.FAULT)

    def _quick_stop_is_over(self, amplifier: AmplifierFeedback) -> bool:
        """Over when the drive has switched itself off, or has had its time (it may hold in quick stop active).

        A brake that servod sequences closes before, when the drive has come to rest; the drive holds meanwhile.
        """
        off = amplifier.age_cycles == 0 and amplifier.state.off
        overdue = self._cycles_in_state > self._timeout_cycles
        if self._brake is not None and self._brake.by_output:
            return self._brake.watch_stop(amplifier, self._torque_on, overdue) or off
        stopping = amplifier.state is DriveState.QUICK_STOP_ACTIVE
        return off or overdue or (stopping and self._rest is not None and self._rest.rests(amplifier))

    def _torque_share(self) -> float:
        if self.state == AxisState.RAMPING:
            return max(0.0, 1.0 - self._cycles_in_state / self._ramp_cycles)
        return 1.0 if self.state.controlled else 0.0


_GOAL: dict[AxisState, Goal] = {
    AxisState.DISABLED: Goal.OFF,
    AxisState.ENABLING: Goal.ENABLED,
    AxisState.ENABLED: Goal.ENABLED,
    AxisState.BRAKING: Goal.ENABLED,
    AxisState.RAMPING: Goal.ENABLED,
    AxisState.QUICK_STOPPING: Goal.QUICK_STOP,
    AxisState.FAULT: Goal.OFF,
    AxisState.PROVING: Goal.ENABLED,
    AxisState.RELEASING: Goal.ENABLED,
    AxisState.ENGAGING: Goal.ENABLED,
}
