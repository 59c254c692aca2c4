"""CiA 402 amplifier: the cycle face. Steps (2) and (5) of the cycle: frames to feedback, command to one RPDO.

The control word follows from the present state and the goal alone (drivers/cia402_state.py); what is remembered here
is only what the contract in servod.runtime.fieldbus.devices asks for: ages, the handshake wait and the edge of a
fault reset.
"""

from __future__ import annotations

import struct

from servod.common.units import PER_MILLE, rad_per_count
from servod.drivers.cia402_setup import AmplifierSetup
from servod.drivers.cia402_state import STATE_OF_STATUS, control_words, quick_stop_stays, reached_states
from servod.drivers.cia402_target import TARGETS
from servod.drivers.pdo_codec import codec, find, lost_after_cycles, slot
from servod.runtime.fieldbus.cia import (
    CW_DISABLE_VOLTAGE,
    CW_ENABLE_OPERATION,
    CW_FAULT_RESET,
    CW_HALT,
    CW_QUICK_STOP,
    EMCY_BASE,
    SW_REMOTE,
    SW_VOLTAGE_ENABLED,
    Emcy,
    Obj402,
)
from servod.runtime.fieldbus.devices import (
    HANDSHAKE_SYNCS,
    NEVER_CYCLES,
    AmplifierCommand,
    AmplifierFeedback,
    DriveInput,
    Driver,
    DriveState,
    Goal,
    Mode,
    NodePlan,
    Reason,
)

#: Lengths of the objects that this driver decodes and encodes (CiA 402).
_FORMATS: dict[int, str] = {
    Obj402.CONTROL_WORD: "H",
    Obj402.STATUS_WORD: "H",
    Obj402.POSITION_ACTUAL: "i",
    Obj402.VELOCITY_ACTUAL: "i",
    Obj402.TORQUE_ACTUAL: "h",
    Obj402.MODE_DISPLAY: "b",
    Obj402.ERROR_CODE: "H",
    Obj402.DIGITAL_INPUTS: "I",
    Obj402.DIGITAL_OUTPUTS: "I",
    Obj402.TARGET_TORQUE: "h",
    Obj402.TARGET_POSITION: "i",
    Obj402.TARGET_VELOCITY: "i",
}
_EMCY = struct.Struct("<HB5s")
_MODE_NOT_KNOWN = -1
#: A brake by output is open in no other state, and for no other goal.
_TORQUE_STATES = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_TORQUE_GOALS = (Goal.ENABLED, Goal.QUICK_STOP)


class Cia402Amplifier:
    """Cycle face of a CiA 402 amplifier; see servod.runtime.fieldbus.devices for the behaviour it keeps."""

    def __init__(self, plan: NodePlan) -> None:
        facts = plan.facts
        self._wanted_mode = Mode(int(facts["mode"]))
        self._acting_modes = (int(self._wanted_mode), _MODE_NOT_KNOWN)  # in another mode the target means another thing
        self._target = TARGETS[self._wanted_mode](facts)
        self._input_rows = [tuple(row) for row in facts.get("inputs", ())]
        self._bind_pdos(plan)
        self._control_words = control_words(int(facts["quick_stop_option"]))
        self._reached = reached_states(int(facts["quick_stop_option"]))
        self._stays_in_quick_stop = quick_stop_stays(int(facts["quick_stop_option"]))
        gear = float(facts["gear_ratio"])
        turn = int(facts["counts_per_turn"])
        self._rad_per_count = int(facts["position_direction"]) * rad_per_count(turn) / gear
        rated_nm = float(facts["rated_torque_nm"])
        self._nm_per_mille = int(facts["torque_direction"]) * rated_nm * gear / PER_MILLE
        self.ignored_frames = 0  # too short for the mapping
        self._time_ns = 0
        self._age_cycles = NEVER_CYCLES
        self._slow_age_cycles = 0
        self._state = DriveState.UNKNOWN
        self._status_word = 0
        self._mode = _MODE_NOT_KNOWN
        self._position_counts = 0  # as on the wire, 32 bits
        self._unwrapped_counts: int | None = None
        self._torque_per_mille = 0
        self._error_code = 0
        self._sto_error = int(facts.get("sto_error", 0))
        self._inputs = 0  # bits of DriveInput that are active
        self._inputs_age_cycles = 0  # since all of them were last said to be
        self._commands_missed = False
        self._feedback: AmplifierFeedback | None = None
        self._goal = Goal.OFF
        self._halt = False
        self._control_word = CW_DISABLE_VOLTAGE
        self._handshake = 0  # cycles to wait before judging
        self._reset_requested = False  # level of the request in the last cycle, for its rising edge
        self._resets_pending = 0
        self._reset_hold = 0

    def _bind_pdos(self, plan: NodePlan) -> None:
        feedback = find(plan, False, (Obj402.STATUS_WORD,))
        command = find(plan, True, (Obj402.CONTROL_WORD, self._target.index))
        slow = next((p for p in plan.pdos if Obj402.MODE_DISPLAY in {e.index for e in p.entries}), None)
        self._feedback_id, self._feedback_codec = feedback.cob_id, codec(feedback, _FORMATS, plan.driver)
        self._status_slot = slot(feedback, Obj402.STATUS_WORD)
        self._position_slot = slot(feedback, Obj402.POSITION_ACTUAL)
        self._torque_slot = slot(feedback, Obj402.TORQUE_ACTUAL)
        self._command_id, self._command_codec = command.cob_id, codec(command, _FORMATS, plan.driver)
        self._word_first = slot(command, Obj402.CONTROL_WORD) == 0
        brake = plan.facts.get("brake")
        self._brake: tuple[int, int] | None = None if brake is None else (brake[0], brake[1])
        self._slow_id, self._slow_codec = -1, struct.Struct("<bH")
        self._mode_slot, self._error_slot, self._inputs_slot = 0, 1, -1
        if slow is not None:
            self._slow_id, self._slow_codec = slow.cob_id, codec(slow, _FORMATS, plan.driver)
            self._mode_slot, self._error_slot = slot(slow, Obj402.MODE_DISPLAY), slot(slow, Obj402.ERROR_CODE)
            self._inputs_slot = slot(slow, Obj402.DIGITAL_INPUTS) if self._input_rows else -1
        self._slow_limit_cycles = lost_after_cycles(slow, float(plan.facts["period_s"]))
        self._emcy_id = EMCY_BASE + plan.node_id
        slow_ids = () if slow is None else (self._slow_id,)
        self.receive_ids: tuple[int, ...] = (self._feedback_id, *slow_ids, self._emcy_id)
        self.sync_frames = 1

    def on_frame(self, can_id: int, data: bytes, time_ns: int) -> bool:
        """Take one frame; True when it was this cycle's synchronous feedback. Short frames are ignored and counted."""
        if can_id == self._feedback_id:
            if len(data) < self._feedback_codec.size:
                self.ignored_frames += 1
                return False
            self._take_feedback(self._feedback_codec.unpack_from(data), time_ns)
            return True
        if can_id == self._slow_id:
            if len(data) < self._slow_codec.size:
                self.ignored_frames += 1
            else:
                values = self._slow_codec.unpack_from(data)
                self._mode, self._error_code = values[self._mode_slot], values[self._error_slot]
                self._slow_age_cycles, self._feedback = 0, None
                if self._inputs_slot >= 0:
                    word = values[self._inputs_slot]
                    self._take_inputs(sum(flag for flag, mask, active in self._input_rows if word & mask == active))
        elif can_id == self._emcy_id:
            if len(data) < _EMCY.size:
                self.ignored_frames += 1
            else:
                self._take_emergency(_EMCY.unpack_from(data)[0])
        return False

    def _take_inputs(self, active: int) -> None:
        """An active input stays so until the drive has had several event timers to say it again: whoever sends the
        PDO in the drive's name, with the input released, hides no emergency stop."""
        if active & self._inputs == self._inputs:
            self._inputs, self._inputs_age_cycles = active, 0
        elif self._inputs_age_cycles > (self._slow_limit_cycles or 0):
            self._inputs = active
        else:
            self._inputs |= active

    def _take_emergency(self, code: int) -> None:
        """The drive tells of the deadline of its RPDO once, and takes that back when commands come again."""
        self._error_code, self._feedback = code, None
        if code == Emcy.RPDO_TIME_OUT:
            self._commands_missed = True
        elif code >> 8 == 0:
            self._commands_missed = False

    def _take_feedback(self, values: tuple[int, ...], time_ns: int) -> None:
        self._status_word = status_word = values[self._status_slot]
        self._state = STATE_OF_STATUS[status_word & 0x7F]
        position = values[self._position_slot]
        if self._unwrapped_counts is None:
            self._unwrapped_counts = position
        else:  # shortest way on a 32-bit counter
            step = (position - self._position_counts + 0x80000000 & 0xFFFFFFFF) - 0x80000000
            self._unwrapped_counts += step
        self._position_counts = position
        self._torque_per_mille = values[self._torque_slot]
        self._time_ns, self._age_cycles, self._feedback = time_ns, 0, None

    def read(self) -> AmplifierFeedback:
        """The feedback of this cycle; the same value until a new frame comes or `write` closes the cycle."""
        if self._feedback is None:
            reasons = int(self._reasons())  # plain: what is asked of it in every cycle costs a microsecond else
            if self._commands_missed:
                reasons |= int(Reason.COMMANDS_MISSED)
            self._feedback = AmplifierFeedback(
                self._time_ns,
                self._age_cycles,
                self._state,
                self._status_word,
                self._shown_mode(),
                (self._unwrapped_counts or 0) * self._rad_per_count,
                self._torque_per_mille * self._nm_per_mille,
                self._error_code,
                reasons == 0,
                reasons,
                self._active_inputs(),
            )
        return self._feedback

    def _slow_lost(self) -> bool:
        return self._slow_limit_cycles is not None and self._slow_age_cycles > self._slow_limit_cycles

    def _active_inputs(self) -> int:
        """Inputs that are not heard any more are taken for active: a stop that cannot be seen is one."""
        active = sum(flag for flag, _, _ in self._input_rows) if self._slow_lost() else self._inputs
        in_fault = self._state in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
        by_error_code = self._sto_error and in_fault and self._error_code == self._sto_error
        return active | DriveInput.STO_TOLD if by_error_code else active

    def _shown_mode(self) -> int:
        """The mode last shown; one that is not shown any more is a wrong one while the drive acts on targets.

        The target goes on meanwhile as the last mode meant it, so that the axis can be brought down in order.
        """
        if not self._slow_lost():
            return self._mode
        return Mode.NONE if self._state == DriveState.OPERATION_ENABLED else _MODE_NOT_KNOWN

    def _reasons(self) -> int:
        """Why the goal of the last command is not reached; zero when it is."""
        if self._age_cycles >= HANDSHAKE_SYNCS or self._unwrapped_counts is None:
            return Reason.NO_FEEDBACK
        if self._state == DriveState.UNKNOWN:
            return Reason.STATE_UNKNOWN
        shown = self._slow_id < 0 or (self._mode == self._wanted_mode and not self._slow_lost())
        mode_shown = shown or self._goal != Goal.ENABLED
        if self._reached[self._goal][self._state]:
            reasons = Reason.HALTED if self._halt else Reason.NONE
            return reasons if mode_shown else reasons | Reason.MODE_NOT_SHOWN
        if self._handshake > 0:
            return Reason.HANDSHAKE
        return self._why_not(mode_shown)

    def _why_not(self, mode_shown: bool) -> int:
        state, reasons = self._state, Reason.NONE
        if state in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            return Reason.IN_FAULT
        if state == DriveState.NOT_READY_TO_SWITCH_ON:
            reasons |= Reason.NOT_READY
        if state == DriveState.QUICK_STOP_ACTIVE and self._stays_in_quick_stop:
            reasons |= Reason.QUICK_STOP_HOLDS
        if state == DriveState.SWITCH_ON_DISABLED and not self._status_word & SW_VOLTAGE_ENABLED:
            reasons |= Reason.NO_VOLTAGE
        if not self._status_word & SW_REMOTE:
            reasons |= Reason.REMOTE_OFF
        if not mode_shown:
            reasons |= Reason.MODE_NOT_SHOWN
        return reasons or Reason.HANDSHAKE

    def write(self, command: AmplifierCommand) -> tuple[int, bytes]:
        """Plan the control word and encode the command; closes the cycle."""
        goal, state = command.goal, self._state
        word = self._control_words[goal][state]
        if goal == Goal.ENABLED and state == DriveState.OPERATION_ENABLED and self._mode in self._acting_modes:
            target = self._target.live(command)
            if target is None:  # not finite: nothing of it may reach the wire
                word, target = CW_DISABLE_VOLTAGE, self._idle_target(False)
            else:
                word |= self._target.control_bits(target, self._status_word)
        else:
            target = self._idle_target(state == DriveState.QUICK_STOP_ACTIVE and word == CW_ENABLE_OPERATION)
        if command.halt and word & CW_ENABLE_OPERATION == CW_ENABLE_OPERATION:
            word |= CW_HALT
        opens = command.release_brake and goal in _TORQUE_GOALS and state in _TORQUE_STATES and word & CW_QUICK_STOP
        word |= self._reset_bit(command.reset_fault, state)
        self._close_cycle(goal, command.halt, word)
        values = (word, target) if self._word_first else (target, word)
        outputs = () if self._brake is None else (self._brake[1 if opens else 0],)  # mapped last
        return self._command_id, self._command_codec.pack(*values, *outputs)

    def _idle_target(self, holding: bool) -> int:
        return self._target.idle(self._position_counts, self._torque_per_mille, holding)

    def _reset_bit(self, requested: bool, state: DriveState) -> int:
        """One rising edge of bit 7 for each request, held for the handshake time so that one lost frame is no harm."""
        if requested and not self._reset_requested:
            self._resets_pending = min(self._resets_pending + 1, 2)
        self._reset_requested = requested
        if self._reset_hold > 0:
            self._reset_hold -= 1
        elif self._resets_pending and state == DriveState.FAULT:
            self._resets_pending -= 1
            self._reset_hold = HANDSHAKE_SYNCS
        else:
            self._resets_pending = 0  # a request without a fault is not kept for the next one
        return CW_FAULT_RESET if self._reset_hold > 0 else 0

    def _close_cycle(self, goal: Goal, halt: bool, word: int) -> None:
        if word != self._control_word or goal != self._goal:
            self._handshake = HANDSHAKE_SYNCS
        elif self._handshake > 0:
            self._handshake -= 1
        self._goal, self._halt, self._control_word = goal, halt, word
        self._age_cycles += 1
        self._slow_age_cycles += 1
        self._inputs_age_cycles += 1
        self._feedback = None


DRIVER = Driver(kind="amplifier", setup=AmplifierSetup, cyclic=Cia402Amplifier)
