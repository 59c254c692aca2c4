"""The one table of faults: code, cause, remedy, and what the axis does. Log, command line and documentation read it.

Stands on nothing. Codes are stable: recordings and the loop's records carry them as bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Reaction(IntEnum):
    """What a fault does to the axis, weakest first; the strongest of all present faults wins."""

    NONE = 0  # reported only
    CLIP = 1  # the value is limited, the motion goes on
    RAMP_DOWN = 2  # torque is ramped to zero, then the drive is disabled
    QUICK_STOP = 3  # the drive stops the axis by its own quick-stop option (0x605A)
    DISABLE = 4  # the drive is commanded to switch on disabled at once, torque zero


class FaultCode(IntEnum):
    """Number of a fault: its bit in the cycle record's fault word, and its row in FAULTS."""

    TORQUE_CLIPPED = 0
    TORQUE_RATE_CLIPPED = 1
    SPEED_LIMIT = 2
    POSITION_LIMIT = 3
    FOLLOWING_ERROR = 4
    ENCODER_IMPLAUSIBLE = 5
    ENCODER_ALARM = 6
    FEEDBACK_STALE = 7
    NOT_FINITE = 8
    DEADLINE_LATE = 9
    DEADLINE_BUDGET = 10
    DRIVE_FAULT = 11
    DRIVE_RESET = 12
    DRIVE_LEFT_OPERATION = 13
    DRIVE_LIMITS_TORQUE = 14
    DRIVE_STATUS_UNKNOWN = 15
    DRIVE_MODE_WRONG = 16
    DRIVE_WARNING = 17
    ENABLE_TIMEOUT = 18
    NODE_HEARTBEAT_LOST = 19
    BUS_OFF = 20
    BUS_QUEUE_FULL = 21
    BUS_DOWN = 22
    SUPERVISOR_LOST = 23
    LOOP_LOST = 24
    RECORDER_FAILED = 25
    DRIVE_STAYS_POWERED = 26
    COMMANDS_LOST = 27
    SECOND_MASTER = 28
    WIRING_NOT_PROVEN = 29
    NODE_LEFT_OPERATIONAL = 30
    DAEMON_LOST = 31
    CHANNEL_CORRUPT = 32
    FOREIGN_SDO = 33
    FOREIGN_FEEDBACK = 34
    GUARD_CHANGED = 35
    TORQUE_IMPLAUSIBLE = 36
    DUPLICATE_NODE = 37
    ESTOP_ACTIVE = 38
    STO_ACTIVE = 39
    OSCILLATES = 40
    PROMISE_BROKEN = 41


#: Faults after which the nodes are not as they were configured: only a new bring-up may enable the axis again.
NEEDS_RESTART = frozenset(
    {
        FaultCode.DRIVE_RESET,
        FaultCode.NODE_HEARTBEAT_LOST,
        FaultCode.BUS_OFF,
        FaultCode.BUS_DOWN,
        FaultCode.DRIVE_STAYS_POWERED,
        FaultCode.COMMANDS_LOST,
        FaultCode.NODE_LEFT_OPERATIONAL,
        FaultCode.FOREIGN_SDO,
        FaultCode.DUPLICATE_NODE,
        FaultCode.GUARD_CHANGED,
    }
)


@dataclass(frozen=True, slots=True)
class Fault:
    """One row of the fault table: `cause` and `remedy` are plain sentences for the person at the machine."""

    code: FaultCode
    reaction: Reaction
    cause: str
    remedy: str

    @property
    def bit(self) -> int:
        """This fault's bit in the cycle record's fault word."""
        return 1 << self.code


def _row(code: FaultCode, reaction: Reaction, cause: str, remedy: str) -> tuple[FaultCode, Fault]:
    return code, Fault(code, reaction, cause, remedy)


_C, _R = FaultCode, Reaction


#: The one table of faults. Reaction is what the limits or the axis do in the same cycle.
FAULTS: dict[FaultCode, Fault] = dict(
    [
        _row(
            _C.TORQUE_CLIPPED,
            _R.CLIP,
            "The controller asked for more torque than limits.torque_nm.",
            "Ask for a slower motion, or raise limits.torque_nm if motor and joint stand it.",
        ),
        _row(
            _C.TORQUE_RATE_CLIPPED,
            _R.CLIP,
            "The controller changed the torque faster than limits.torque_rate_nm_per_s.",
            "Check the velocity filter and the gains for noise; raise the rate limit if the mechanics stand it.",
        ),
        _row(
            _C.SPEED_LIMIT,
            _R.QUICK_STOP,
            "The joint turned faster than limits.speed_rad_s.",
            "Look at the pre-fault recording; check sign and scale of the torque before enabling again.",
        ),
        _row(
            _C.POSITION_LIMIT,
            _R.QUICK_STOP,
            "The joint left the range limits.position_min_rad to limits.position_max_rad.",
            "Move the joint back by hand with the drive disabled, then choose a smaller motion.",
        ),
        _row(
            _C.FOLLOWING_ERROR,
            _R.RAMP_DOWN,
            "Position and reference differ by more than limits.following_error_rad. (A joint that moves is stopped by "
            "the drive's quick stop.)",
            "Check for a blocked joint, a wrong polarity or too fast a reference; widen the window only after that.",
        ),
        _row(
            _C.ENCODER_IMPLAUSIBLE,
            _R.DISABLE,
            "The amplifier's position and the encoder's position disagree by more than limits.encoder_mismatch_rad.",
            "Check coupling, counts per turn, gear ratio and direction of both; then enable again.",
        ),
        _row(
            _C.ENCODER_ALARM,
            _R.DISABLE,
            "The encoder reports an alarm (CiA 406, 0x6503), or its alarm word comes no more.",
            "Check supply and mounting of the encoder; its EMCY is in the journal, and a daemon that starts while the "
            "alarm stays names the alarm word (0x6503).",
        ),
        _row(
            _C.FEEDBACK_STALE,
            _R.QUICK_STOP,
            "No fresh feedback for limits.stale_cycles cycles in a row.",
            "Check wiring, termination and bus load; see `servoctl status` for the error counters.",
        ),
        _row(
            _C.NOT_FINITE,
            _R.DISABLE,
            "The controller or the feedback gave a number that is not finite (NaN or infinity).",
            "Roll the gain set back; keep the pre-fault recording, it shows the state that caused it.",
        ),
        _row(
            _C.DEADLINE_LATE,
            _R.NONE,
            "One or more cycles started late and were skipped.",
            "Occasional skips are normal without a real-time kernel; `servoctl bench` shows how this machine does.",
        ),
        _row(
            _C.DEADLINE_BUDGET,
            _R.QUICK_STOP,
            "More cycles were late than limits.late_cycles allows.",
            "Find what takes the processor from the loop: see the real-time report in `servoctl status`, pin and "
            "isolate a core.",
        ),
        _row(
            _C.DRIVE_FAULT,
            _R.DISABLE,
            "The drive went to its fault state by itself (status word, 0x603F, EMCY).",
            "Look up the error code in the drive's manual, remove the cause, then `servoctl enable --reset-fault`.",
        ),
        _row(
            _C.DRIVE_RESET,
            _R.DISABLE,
            "A node sent its boot-up message while it should have been operational: it was reset.",
            "Check the supply of the node. The service configures it again by itself; restart a daemon without --wait.",
        ),
        _row(
            _C.DRIVE_LEFT_OPERATION,
            _R.DISABLE,
            "The drive left operation enabled without being asked.",
            "Check the enable input, the STO circuit and the drive's own limits.",
        ),
        _row(
            _C.DRIVE_LIMITS_TORQUE,
            _R.NONE,
            "The drive itself limits the torque (status word bit 11).",
            "Compare limits.torque_nm with 0x6072, 0x60E0, 0x60E1 and the drive's current limit.",
        ),
        _row(
            _C.DRIVE_STATUS_UNKNOWN,
            _R.DISABLE,
            "The drive's status word matches no state of CiA 402.",
            "Check the PDO mapping and the quirks entry of this drive; `servoctl status` shows the raw word.",
        ),
        _row(
            _C.DRIVE_MODE_WRONG,
            _R.QUICK_STOP,
            "The drive does not show cyclic synchronous torque mode (0x6061) while enabled.",
            "Check that nothing else writes 0x6060 and that the drive supports the mode (0x6502).",
        ),
        _row(
            _C.DRIVE_WARNING,
            _R.NONE,
            "The drive shows its warning bit (status word bit 7).",
            "Read the drive's warning in its manual; temperature and supply are the usual ones.",
        ),
        _row(
            _C.ENABLE_TIMEOUT,
            _R.DISABLE,
            "The drive did not reach the goal state in time.",
            "`servoctl status` names what was missing: supply voltage, NMT state, mode, or the enable input.",
        ),
        _row(
            _C.NODE_HEARTBEAT_LOST,
            _R.QUICK_STOP,
            "A node's heartbeat did not arrive within its time.",
            "Check the node's supply and the bus wiring. The service begins again by itself once the node answers; "
            "restart a daemon without --wait.",
        ),
        _row(
            _C.BUS_OFF,
            _R.QUICK_STOP,
            "The CAN controller is bus-off: too many transmit errors.",
            "Check bit rate, termination (60 ohm across the lines) and wiring. The service begins again by itself once "
            "the nodes answer; restart a daemon without --wait.",
        ),
        _row(
            _C.BUS_QUEUE_FULL,
            _R.NONE,
            "A frame could not be queued because the transmit queue was full.",
            "Raise txqueuelen (the shipped link file sets it) and check the bus load.",
        ),
        _row(
            _C.BUS_DOWN,
            _R.QUICK_STOP,
            "The CAN interface is down or the bus connection was closed.",
            "Bring the interface up (`ip link set can0 up`). The service begins again by itself once the nodes answer; "
            "restart a daemon without --wait.",
        ),
        _row(
            _C.SUPERVISOR_LOST,
            _R.RAMP_DOWN,
            "The supervisor process died or hangs; the loop stops the axis by itself.",
            "See the journal for the reason, or what else took the processor; systemd restarts the service, enabling "
            "stays an explicit act.",
        ),
        _row(
            _C.LOOP_LOST,
            _R.DISABLE,
            "The loop process died or hung; the supervisor switched the drive off, braked to rest. "
            "A drive that it does not reach stops by its own heartbeat consumer (0x1016).",
            "See the journal and the pre-fault recording; restart the service.",
        ),
        _row(
            _C.RECORDER_FAILED,
            _R.NONE,
            "The recording could not be written.",
            "Check free space and rights of recorder.directory.",
        ),
        _row(
            _C.DRIVE_STAYS_POWERED,
            _R.DISABLE,
            "The drive stays powered, or is not heard, although it was told to switch off.",
            "Cut its supply or pull its enable input; then look for what keeps the control word (RPDO1) from the drive "
            "and restart the daemon.",
        ),
        _row(
            _C.COMMANDS_LOST,
            _R.DISABLE,
            "The powered drive misses the command frames (RPDO1; EMCY 0x8250), takes none from the bus any more "
            "(status word bit 9) or does not follow them (bit 12); it was stopped by NMT.",
            "Check wiring and plugs, and whether somebody else commands the drive; then restart the daemon.",
        ),
        _row(
            _C.SECOND_MASTER,
            _R.QUICK_STOP,
            "Somebody else sends frames that only this master may send: SYNC, NMT, TIME, LSS, a command (RPDO), the "
            "master's heartbeat or its EMCY.",
            "Find the other master on the bus: a second daemon, another controller, a service tool, or a node that "
            "produces SYNC (0x1005 bit 30).",
        ),
        _row(
            _C.WIRING_NOT_PROVEN,
            _R.DISABLE,
            "The bounded test before the first torque found a wrong sign, direction or scale, or no answer.",
            "`servoctl status` and the journal name the check, what it saw and the key to correct; then `servoctl "
            "enable --reset-fault` repeats it.",
        ),
        _row(
            _C.NODE_LEFT_OPERATIONAL,
            _R.QUICK_STOP,
            "A node left the NMT state operational: somebody sent it an NMT command, or it did so by itself.",
            "Find who sends NMT commands (another master, a service tool), switch a stopped node off and on, then "
            "restart the daemon.",
        ),
        _row(
            _C.DAEMON_LOST,
            _R.NONE,
            "servod ended without an orderly stop: it was killed, it crashed, or the machine lost its power. Loop and "
            "drive stopped the axis by themselves.",
            "See the journal of that time (`journalctl -u 'servod@*'`), and look at the axis before it is enabled.",
        ),
        _row(
            _C.CHANNEL_CORRUPT,
            _R.QUICK_STOP,
            "A message between supervisor and loop came corrupt, out of order or too late: its number, checksum or age "
            "is wrong. Nothing of it was used.",
            "`servoctl enable --reset-fault`. If it comes again, test the machine's memory (EDAC counters, memtest86+) "
            "and look for what starves the processes.",
        ),
        _row(
            _C.FOREIGN_SDO,
            _R.QUICK_STOP,
            "Somebody else speaks SDO with a node of the axis: a request that this master did not send, or an answer "
            "that it did not ask for. Limits and guards of the node may be changed.",
            "The journal has the frame and its object. Take the service tool or the other master off the bus, then "
            "restart the daemon, which configures the node again. What servod leaves as it finds it (the drive's own "
            "torque limit 0x6072, its gains) somebody must set back, or a power cycle does.",
        ),
        _row(
            _C.FOREIGN_FEEDBACK,
            _R.QUICK_STOP,
            "A node's synchronous feedback (TPDO) came that no SYNC asked for, or a TPDO that is switched off or "
            "shorter than its mapping: somebody else sends it, or SYNC reaches the nodes twice.",
            "Find who else sends the node's frames, or the gateway that repeats SYNC; then `servoctl enable "
            "--reset-fault`.",
        ),
        _row(
            _C.GUARD_CHANGED,
            _R.QUICK_STOP,
            "A guard in the drive does not read as servod wrote it: a limit, its way to stop, its reaction to a dead "
            "master. The journal names the object.",
            "Find who writes to the drive (a service tool, another master), then restart the daemon, which writes the "
            "guards again.",
        ),
        _row(
            _C.TORQUE_IMPLAUSIBLE,
            _R.QUICK_STOP,
            "The torque that the drive says it gives (0x6077) is far from the torque that it was told, by more than "
            "limits.torque_mismatch_nm.",
            "Look for a drive in current limit, a wrong motor or lost phase, a wrong 0x6077; then `servoctl enable "
            "--reset-fault`.",
        ),
        _row(
            _C.DUPLICATE_NODE,
            _R.QUICK_STOP,
            "Two senders use one node id: heartbeats come between those of the node, heartbeat or EMCY have another "
            "length or NMT state than CiA 301 gives them, or an EMCY takes back an error that was never heard of, "
            "because somebody else sent it or because the bus lost the error's own frame.",
            "Give each node its own id (`servoctl scan` shows who is there), find who sends in its name, or repair the "
            "bus where it was disturbed; then restart the daemon.",
        ),
        _row(
            _C.ESTOP_ACTIVE,
            _R.QUICK_STOP,
            "The emergency stop is active (amplifier.inputs.estop_bit), its wire is broken, or the drive's inputs "
            "(0x60FD) are not heard any more.",
            "Make the machine safe and release the emergency stop, then `servoctl enable --reset-fault`. Releasing it "
            "enables nothing.",
        ),
        _row(
            _C.STO_ACTIVE,
            _R.DISABLE,
            "Safe torque off is active (amplifier.inputs.sto_bit or sto_error): the drive has no torque, so the joint "
            "coasts.",
            "Find who opened the STO circuit and why, close it, then `servoctl enable --reset-fault`.",
        ),
        _row(
            _C.OSCILLATES,
            _R.QUICK_STOP,
            "The torque swings to and fro by more than limits.oscillation_nm, again and again, and the reference does "
            "not ask for it: the feedback loop is unstable, or something shakes the joint.",
            "Go back to gains that were quiet (`servoctl gains rollback`); look for a loose coupling, a lower torque "
            "rate, a longer delay or another inertia than the gains were designed for; then `servoctl enable "
            "--reset-fault`.",
        ),
        _row(
            _C.PROMISE_BROKEN,
            _R.NONE,
            "The joint is not the one any more that the running gain set is certified for, or it tracks worse than the "
            "certificate promises.",
            "See what changed (`servoctl status`): lubrication, temperature, load, a tool, a bearing. Let `servoctl "
            "diagnose` look at a recording; if it stays, identify the axis again and make a new set (`servoctl "
            "commission`), or go back to gains that ask for less (`servoctl gains rollback`).",
        ),
    ]
)


def faults_in(fault_word: int) -> list[Fault]:
    """The rows of the fault table whose bits are set in `fault_word`, in table order."""
    return [f for f in FAULTS.values() if fault_word & f.bit]


def fault_text(fault_word: int) -> str:
    """The faults of `fault_word` in one line: code, cause and remedy of each."""
    return " ".join(f"{f.code.name}: {f.cause} {f.remedy}" for f in faults_in(fault_word)) or "No fault is latched."
