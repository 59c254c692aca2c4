"""What the target object of the RPDO carries in each mode of operation: torque, velocity or position, in wire counts.

Step (5) of the cycle. Each class knows its object, how a command in SI units of the joint becomes counts, and what to
send while nothing may act: zero, or the value now present, so that entering the mode never makes a jump.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

from servod.common.errors import BadInput
from servod.common.units import PER_MILLE, TWO_PI
from servod.runtime.fieldbus.cia import SW_FOLLOWS_COMMAND, Obj402
from servod.runtime.fieldbus.devices import AmplifierCommand, Mode

_INT16_MAX = 0x7FFF
_INT32_MAX = 0x7FFFFFFF
_CW_NEW_SET_POINT = 1 << 4
_CW_CHANGE_AT_ONCE = 1 << 5


class Target(Protocol):
    """One way to fill the target of the RPDO."""

    index: Obj402
    bits: int

    def live(self, command: AmplifierCommand) -> int | None:
        """Counts of the command; None when it is not finite and must not reach the wire."""
        ...

    def idle(self, position_counts: int, torque_per_mille: int, holding: bool) -> int:
        """Counts while the command may not act; `holding`: the drive holds the load and will take over at once."""
        ...

    def control_bits(self, target: int, status_word: int) -> int:
        """Mode-specific bits of the control word (4 to 6, 9)."""
        ...


class CyclicTarget:
    """A target that acts at every SYNC: the cyclic synchronous modes need no bits of the control word."""

    def control_bits(self, target: int, status_word: int) -> int:
        """None."""
        return 0


class TorqueTarget(CyclicTarget):
    """0x6071 in cst: thousandths of rated torque, motor side; saturates at the object's 16 bits."""

    index = Obj402.TARGET_TORQUE
    bits = 16

    def __init__(self, facts: dict[str, Any]) -> None:
        joint_nm = float(facts["rated_torque_nm"]) * float(facts["gear_ratio"])
        self._per_mille_per_nm = int(facts["torque_direction"]) * PER_MILLE / joint_nm

    def live(self, command: AmplifierCommand) -> int | None:
        """Per mille of rated torque."""
        torque = command.torque_nm * self._per_mille_per_nm
        if not math.isfinite(torque):
            return None
        return max(-_INT16_MAX, min(_INT16_MAX, round(torque)))

    def idle(self, position_counts: int, torque_per_mille: int, holding: bool) -> int:
        """The torque now produced while the drive holds the load, else zero."""
        return torque_per_mille if holding else 0


class VelocityTarget(CyclicTarget):
    """0x60FF in csv, in counts per second of the motor encoder."""

    index = Obj402.TARGET_VELOCITY
    bits = 32

    def __init__(self, facts: dict[str, Any]) -> None:
        self._counts_per_rad = _counts_per_joint_rad(facts)

    def live(self, command: AmplifierCommand) -> int | None:
        """Counts per second."""
        velocity = command.setpoint * self._counts_per_rad
        if not math.isfinite(velocity):
            return None
        return max(-_INT32_MAX, min(_INT32_MAX, round(velocity)))

    def idle(self, position_counts: int, torque_per_mille: int, holding: bool) -> int:
        """Standstill."""
        return 0


class PositionTarget(CyclicTarget):
    """0x607A in csp, in counts of the motor encoder; wraps as the drive's 32-bit counter does."""

    index = Obj402.TARGET_POSITION
    bits = 32

    def __init__(self, facts: dict[str, Any]) -> None:
        self._counts_per_rad = _counts_per_joint_rad(facts)

    def live(self, command: AmplifierCommand) -> int | None:
        """Counts."""
        position = command.setpoint * self._counts_per_rad
        if not math.isfinite(position):
            return None
        return ((round(position) + 0x80000000) & 0xFFFFFFFF) - 0x80000000

    def idle(self, position_counts: int, torque_per_mille: int, holding: bool) -> int:
        """The position now present."""
        return position_counts


class ProfilePositionTarget(PositionTarget):
    """0x607A in pp: a new target is handed over by bit 4 (new set-point), answered by status bit 12 (acknowledge)."""

    def __init__(self, facts: dict[str, Any]) -> None:
        super().__init__(facts)
        self._offered: int | None = None  # what the target was when bit 4 rose, which is what the drive takes
        self._raised = False

    def idle(self, position_counts: int, torque_per_mille: int, holding: bool) -> int:
        """The position now present; a drive that comes back gets its target again."""
        self._offered, self._raised = None, False
        return super().idle(position_counts, torque_per_mille, holding)

    def control_bits(self, target: int, status_word: int) -> int:
        """Bit 4 rises only while the drive shows no acknowledge, and falls when it does; bit 5: change at once."""
        if status_word & SW_FOLLOWS_COMMAND:
            self._raised = False
            return _CW_CHANGE_AT_ONCE
        if not self._raised:
            if target == self._offered:
                return _CW_CHANGE_AT_ONCE
            self._offered, self._raised = target, True
        return _CW_CHANGE_AT_ONCE | _CW_NEW_SET_POINT


#: Modes that this driver can run, and what fills the target in each.
TARGETS: dict[Mode, type[TorqueTarget] | type[VelocityTarget] | type[PositionTarget]] = {
    Mode.CYCLIC_SYNC_TORQUE: TorqueTarget,
    Mode.CYCLIC_SYNC_VELOCITY: VelocityTarget,
    Mode.CYCLIC_SYNC_POSITION: PositionTarget,
    Mode.PROFILE_POSITION: ProfilePositionTarget,
}


def _counts_per_joint_rad(facts: dict[str, Any]) -> float:
    direction = int(facts["position_direction"])
    return direction * float(facts["counts_per_turn"]) * float(facts["gear_ratio"]) / TWO_PI


def target_type(mode: Mode) -> type[TorqueTarget] | type[VelocityTarget] | type[PositionTarget]:
    """The target of a mode; raises BadInput for a mode that this driver cannot run."""
    if mode not in TARGETS:
        raise BadInput("driver cia402: mode", mode.name, ", ".join(m.name for m in TARGETS))
    return TARGETS[mode]
