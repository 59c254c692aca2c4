"""Commands from the supervisor to the loop: a number and a row of floats, so that the loop decodes without parsing.

Stands on nothing; written by the supervisor into shared memory, read by the loop at the end of a cycle.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Op(IntEnum):
    """What the loop can be told. Arguments in the comment."""

    NONE = 0
    ENABLE = (
        1  # [reset_fault 0/1, prove 0/1]: with `prove` the test of the wiring is repeated; an axis that is off asks
    )
    # for a CONFIRM
    DISABLE = 2  # [] ramp down, then disable
    QUICK_STOP = 3  # []
    HALT = 4  # [0/1, 0/1] stop the reference and hold / go on; with the second, the motion ends there
    CONFIRM = 5  # [the result of the ENABLE before it]: a second message, so that no single one enables
    ACTIVATE = 6  # [serial, law, n_params, params...]: bumpless change of the controller
    REFERENCE = 7  # [ReferenceKind, arguments...]
    SHUTDOWN = 8  # [] ramp down, disable, end the loop
    NODE_EVENT = 9  # [fault code] something the supervisor saw (heartbeat lost, boot-up, EMCY): raise this fault
    CORRUPT = 10  # [] nobody sends it: what the channel gives in place of a command that came bent or too late


class ReferenceKind(IntEnum):
    """Reference motions. All start at the present reference position and add to it; a table is relative
    to its first sample."""

    HOLD = 0  # []
    SINE = 1  # [amplitude_rad, frequency_hz, duration_s]
    PAPER = 2  # [duration_s]: trajectory (19), x = (0.1 - 0.0033 t) sin(0.2 pi t)
    STEP = 3  # [amplitude_rad, duration_s]
    TABLE = 4  # [n_samples, lowest_rad, highest_rad]: positions in the shared trajectory area, one for each period
    EXCITE = 5  # [n_samples, lowest_rad, highest_rad, window_rad]: as TABLE, then as many torques in N*m to add;
    # when the joint's distance from the reference changes by more than the window, it fades out and ends


class Refusal(IntEnum):
    """Why a command was not carried out; 0 is done. A result below zero is none of these: it confirms an ENABLE."""

    DONE = 0
    NOT_ENABLED = 1
    FAULT_PRESENT = 2
    MOTION_RUNNING = 3
    BAD_ARGUMENT = 4
    OUT_OF_RANGE = 5
    NEEDS_RESTART = 6
    OUTSIDE_LIMITS = 7
    TOO_FAST = 8
    PROVES_ONLY_FROM_OFF = 9
    JUMPS = 10
    NOT_CONFIRMED = 11
    CORRUPT = 12
    ESTOP_ACTIVE = 13
    STO_ACTIVE = 14


REFUSAL_TEXT: dict[Refusal, str] = {
    Refusal.NOT_ENABLED: "the axis is not enabled; run `servoctl enable` first",
    Refusal.FAULT_PRESENT: "a fault is latched; see `servoctl status`, then `servoctl enable --reset-fault`",
    Refusal.MOTION_RUNNING: "a motion is running; `servoctl stop` ends it",
    Refusal.BAD_ARGUMENT: "an argument is not a finite number or out of range",
    Refusal.OUT_OF_RANGE: "the motion would leave limits.position_min_rad to position_max_rad",
    Refusal.NEEDS_RESTART: "a node or the bus was lost; the nodes must be configured again: the service does so by "
    "itself once they answer; else restart the daemon",
    Refusal.OUTSIDE_LIMITS: "the joint is outside limits.position_min_rad to position_max_rad; move it back by hand",
    Refusal.TOO_FAST: "the motion would be faster than limits.speed_rad_s",
    Refusal.PROVES_ONLY_FROM_OFF: "the wiring is tested on the way from off to on; run `servoctl disable` first",
    Refusal.JUMPS: "the reference would jump further from the joint than limits.following_error_rad",
    Refusal.NOT_CONFIRMED: "another command came between the request to enable and its confirmation; try again",
    Refusal.ESTOP_ACTIVE: "the emergency stop is active, or its input is not heard (bit amplifier.inputs.estop_bit of "
    "0x60FD); release it first",
    Refusal.STO_ACTIVE: "the STO circuit is open, or its input is not heard (bit amplifier.inputs.sto_bit of 0x60FD, "
    "or the error amplifier.inputs.sto_error); close it first",
    Refusal.CORRUPT: "the command came to the loop corrupt or too late; see CHANNEL_CORRUPT in `servoctl faults`",
}


class Command(NamedTuple):
    """One command; `seq` grows by one with each and comes back in the cycle record when it was carried out.

    `sent_ns` is on the clock of both sides.
    """

    seq: int
    op: int
    arguments: tuple[float, ...]
    sent_ns: int = 0
