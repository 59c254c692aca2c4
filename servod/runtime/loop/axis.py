"""The axis: from what is wanted and what the drive says to a goal for the drive and a share of torque, each cycle.

Stands between drivers and controller on the data path. It enables only on an explicit request, turns each fault into
its reaction (servod.common.faults.FAULTS), and brings the axis to rest by one of three ways: braking the reference and
then ramping the torque down (DISABLE, SHUTDOWN, a lost supervisor), the drive's quick stop, or voltage off at once.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from servod.common.faults import FAULTS, NEEDS_RESTART, FaultCode, Reaction
from servod.runtime.fieldbus.devices import AmplifierFeedback, DriveState, Goal, Mode, Reason
from servod.runtime.loop.commands import Refusal

_BIT = {code: fault.bit for code, fault in FAULTS.items()}
_MASK = {r: sum(f.bit for f in FAULTS.values() if f.reaction == r) for r in Reaction}
_STATUS_WARNING, _STATUS_REMOTE, _STATUS_LIMIT = 1 << 7, 1 << 9, 1 << 11


class AxisState(IntEnum):
    """What the axis is doing, for people and for the record."""

    DISABLED = 0
    ENABLING = 1
    ENABLED = 2
    BRAKING = 3  # controller still active, reference slowing down
    RAMPING = 4  # torque going to zero
    QUICK_STOPPING = 5  # the drive stops the axis
    FAULT = 6
    PROVING = 7  # before the first torque: the bounded test of the wiring (servod.runtime.loop.wiring.wiring_test)

    @property
    def stopped(self) -> bool:
        """Nothing is commanded; what asks for a standing axis may begin."""
        return self in (AxisState.DISABLED, AxisState.FAULT)

    @property
    def starting(self) -> bool:
        """Nothing is moved under control yet: whatever ends these states switches off at once."""
        return self in (AxisState.ENABLING, AxisState.PROVING)

    @property
    def under_way(self) -> bool:
        """On the way to ENABLED, or there."""
        return self.starting or self is AxisState.ENABLED

    @property
    def controlled(self) -> bool:
        """The controller has the torque, or had it and its torque goes to zero."""
        return self in _CONTROLLED

    @property
    def following(self) -> bool:
        """The joint is to follow a reference."""
        return self in (AxisState.ENABLED, AxisState.BRAKING)

    @property
    def powered(self) -> bool:
        """The loop commands torque: under control, or in the test of the wiring."""
        return self in _CONTROLLED or self is AxisState.PROVING


_CONTROLLED = (AxisState.ENABLED, AxisState.BRAKING, AxisState.RAMPING)
_UNHEARD_MASK = _BIT[FaultCode.DRIVE_STAYS_POWERED] | _BIT[FaultCode.COMMANDS_LOST]
_OFF_MASK = sum(FAULTS[code].bit for code in NEEDS_RESTART)
#: A drive that is told to switch off, or to stop, and is still commanded after this time does not obey.
_OBEY_S = 0.1
#: The test of the wiring ends by itself after its time-out; one that does not is ended so much later.
_PROOF_MARGIN_S = 0.25


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
        self, period_s: float, ramp_down_s: float, enable_timeout_s: float, mode: Mode, proof_timeout_s: float
    ) -> None:
        """Times in seconds; `mode` is what the drive must show while enabled."""
        self.state = AxisState.DISABLED
        self.faults = 0  # present in this cycle
        self.latched = 0  # since the last enable or reset
        self._period_s, self._mode = period_s, int(mode)
        self._ramp_cycles = max(1, round(ramp_down_s / period_s))
        self._timeout_cycles = max(1, round(enable_timeout_s / period_s))
        self._proof_cycles = round((proof_timeout_s + _PROOF_MARGIN_S) / period_s)
        self._cycles_in_state = self._disobeyed_cycles = 0
        self._obey_cycles = max(4, round(_OBEY_S / period_s))
        self._reset_wanted, self._seen_off, self._seen_remote = False, True, False
        self._end_state = AxisState.DISABLED
        self._prove = self._proven = False

    @property
    def goal(self) -> Goal:
        """What the drive shall do in the present state."""
        return _GOAL[self.state]

    @property
    def unheard(self) -> bool:
        """The drive does not follow the control word, or does not get it: other ways must stop it."""
        return bool(self.latched & _UNHEARD_MASK)

    def enable(self, reset_fault: bool, prove: bool = False) -> Refusal:
        """Explicit request to enable; with `reset_fault` latched faults and the drive's fault are reset first.

        With `prove` the drive's power is followed by the state PROVING, which `proven` ends.
        """
        if not self.state.stopped:
            return Refusal.DONE if self.state.under_way else Refusal.MOTION_RUNNING
        if self.latched & _OFF_MASK:
            return Refusal.NEEDS_RESTART
        if reset_fault:
            self.reset_fault()
        if self.latched & ~_MASK[Reaction.NONE] & ~_MASK[Reaction.CLIP]:
            return Refusal.FAULT_PRESENT
        self.latched, self._seen_remote = 0, False
        self._enter(AxisState.ENABLING)
        self._prove, self._proven = prove, False
        return Refusal.DONE

    def proven(self) -> None:
        """The test passed: the axis is enabled in the next cycle."""
        self._proven = True

    def reset_fault(self) -> Refusal:
        """Forget latched faults, but for those that need a restart, and ask the drive once to reset its own."""
        if self.state.powered:
            return Refusal.MOTION_RUNNING
        self.latched, self._reset_wanted = self.latched & _OFF_MASK, True
        if self.state == AxisState.FAULT:
            self._enter(AxisState.DISABLED)
        return Refusal.DONE

    def disable(self) -> None:
        """Bring the axis to rest under control, then switch off."""
        if self.state == AxisState.ENABLED:
            self._stop(AxisState.BRAKING, AxisState.DISABLED)
        elif self.state.starting:
            self._enter(AxisState.DISABLED)

    def quick_stop(self) -> None:
        """Let the drive stop the axis by its quick-stop option."""
        if self.state.controlled:
            failed = self.state != AxisState.ENABLED and self._end_state == AxisState.FAULT
            self._stop(AxisState.QUICK_STOPPING, AxisState.FAULT if failed else AxisState.DISABLED)
        elif self.state.starting:
            self._enter(AxisState.DISABLED)

    def note(self, fault_bits: int) -> None:
        """Latch faults that the supervisor saw, also while disabled."""
        self.latched |= fault_bits

    def step(self, amplifier: AmplifierFeedback, encoder_fresh: bool, faults: int, at_rest: bool) -> AxisOutput:
        """One cycle: `faults` are the bits that limits, bus and supervisor raised; returns what to do.

        `encoder_fresh`: the encoder's sample is of this cycle; `at_rest`: the reference stands still.
        """
        self._cycles_in_state += 1
        self.faults = faults | self._drive_faults(amplifier)
        self.latched |= self.faults & _OFF_MASK
        if not self.state.stopped:
            self._react()
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
            self._react()

    def _enter(self, state: AxisState) -> None:
        self.state, self._cycles_in_state = state, 0

    def _stop(self, way: AxisState, end: AxisState) -> None:
        self._end_state = end
        self._enter(way)

    def _react(self) -> None:
        """Apply the strongest reaction among the present faults; a stop in progress is only ever made stronger."""
        faults, state = self.faults, self.state
        self.latched |= faults
        if not faults:
            return
        if faults & _MASK[Reaction.DISABLE]:
            self._enter(AxisState.FAULT)
        elif faults & _MASK[Reaction.QUICK_STOP]:
            if state.starting:
                self._enter(AxisState.FAULT)
            elif state != AxisState.QUICK_STOPPING:
                self._stop(AxisState.QUICK_STOPPING, AxisState.FAULT)
            self._end_state = AxisState.FAULT
        elif faults & _MASK[Reaction.RAMP_DOWN]:
            self._react_ramp_down(faults)

    def _react_ramp_down(self, faults: int) -> None:
        self._end_state = AxisState.FAULT
        if self.state.starting:
            self._enter(AxisState.FAULT)
        elif self.state == AxisState.ENABLED:
            # A lost supervisor leaves a sound controller: brake first. A following error does not: ramp at once.
            sound = faults & _MASK[Reaction.RAMP_DOWN] == _BIT[FaultCode.SUPERVISOR_LOST]
            self._stop(AxisState.BRAKING if sound else AxisState.RAMPING, AxisState.FAULT)

    def _drive_faults(self, amplifier: AmplifierFeedback) -> int:
        """What the drive's own words say is wrong, as fault bits; stale words say nothing (limits count the age)."""
        faults, state = self._disobedience(amplifier), amplifier.state
        if amplifier.age_cycles > 0:
            return faults
        if amplifier.reasons & Reason.COMMANDS_MISSED and state.commanded:
            faults |= _BIT[FaultCode.COMMANDS_LOST]
        if state in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE) and not self._being_reset():
            faults |= _BIT[FaultCode.DRIVE_FAULT]
        if amplifier.status_word & _STATUS_WARNING:
            faults |= _BIT[FaultCode.DRIVE_WARNING]
        if self.state.powered:
            faults |= self._operation_faults(amplifier)
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
        self._disobeyed_cycles = self._disobeyed_cycles + 1 if disobeys else 0
        return _BIT[FaultCode.DRIVE_STAYS_POWERED] if self._disobeyed_cycles > self._obey_cycles else 0

    def _operation_faults(self, amplifier: AmplifierFeedback) -> int:
        state = amplifier.state
        if state == DriveState.UNKNOWN:
            return _BIT[FaultCode.DRIVE_STATUS_UNKNOWN]
        faults = 0
        if state not in (DriveState.OPERATION_ENABLED, DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            faults |= _BIT[FaultCode.DRIVE_LEFT_OPERATION]
        if amplifier.mode not in (-1, self._mode):
            faults |= _BIT[FaultCode.DRIVE_MODE_WRONG]
        if amplifier.status_word & _STATUS_LIMIT:
            faults |= _BIT[FaultCode.DRIVE_LIMITS_TORQUE]
        if amplifier.status_word & _STATUS_REMOTE:  # some drives never show it, so only its end says something
            self._seen_remote = True
        elif self._seen_remote:
            faults |= _BIT[FaultCode.COMMANDS_LOST]
        return faults

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
        if state == AxisState.BRAKING and (at_rest or self._cycles_in_state > self._ramp_cycles):
            self._enter(AxisState.RAMPING)
        ramped = state == AxisState.RAMPING and self._cycles_in_state >= self._ramp_cycles
        if ramped or (state == AxisState.QUICK_STOPPING and self._quick_stop_is_over(amplifier)):
            self._enter(self._end_state)
        return False

    def _finish_enabling(self, amplifier: AmplifierFeedback, encoder_fresh: bool) -> bool:
        fresh = encoder_fresh and amplifier.age_cycles == 0
        if fresh and amplifier.goal_reached and amplifier.state == DriveState.OPERATION_ENABLED:
            self._enter(AxisState.PROVING if self._prove else AxisState.ENABLED)
            return not self._prove
        if self._cycles_in_state > self._timeout_cycles:
            self._fail(FaultCode.DRIVE_FAULT if amplifier.reasons & Reason.IN_FAULT else FaultCode.ENABLE_TIMEOUT)
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
        """Over when the drive has switched itself off, or has had its time (it may hold in quick stop active)."""
        off = amplifier.age_cycles == 0 and amplifier.state.off
        return off or self._cycles_in_state > self._timeout_cycles

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
}
