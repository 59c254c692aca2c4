"""Hardware abstraction: what an amplifier and an encoder *are*, whatever stands on the wire.

A device is its values **and its behaviour**. A driver has two faces: `Setup` runs in the supervisor, off the control
path, with SDO access; `Amplifier`/`Encoder` run in the loop, once per cycle, and only decode and encode frames.

Behaviour contract (checked for every driver by tests/conformance):

Amplifier
 1. `read` returns the same value until the next cycle's frames arrive; `age_cycles` is 0 exactly when this cycle's
    synchronous feedback came, and grows by one per cycle without. Before the first feedback the state is UNKNOWN and
    the age is at least NEVER_CYCLES.
 2. `write` is asked every cycle and always gives exactly one frame that fits the mapping. Torque is encoded only when
    the present state is OPERATION_ENABLED and the goal is ENABLED; in every other case the frame carries zero torque.
    One exception: going back from quick stop (transition 16) the drive holds the load, so the frame then carries the
    torque now produced. A brake by output is released only on request, and only in OPERATION_ENABLED or
    QUICK_STOP_ACTIVE.
 3. The control word is planned from the present state and the goal alone. A transient state may never be seen.
    After a state change was asked for, the driver waits HANDSHAKE_SYNCS cycles before it judges.
 4. A fault is reset only by an explicit `reset_fault` request: one rising edge for each request.
 5. A status word that matches no state gives UNKNOWN, never a guess; goal ENABLED then gets disable voltage.
 6. Torque that is not finite is never encoded: the frame then carries zero torque and disable voltage.
Encoder
 7. Position is continuous (unwrapped) over any measuring range; the velocity is the position's difference over the
    *measured* time between samples, low-passed; `delay_s` of the driver states what differentiation and filter cost.
 8. A sample that did not come leaves position and velocity as they were and lets `age_cycles` grow; before the first
    one it is at least NEVER_CYCLES.
Both
 9. What comes by event timer (mode, alarms) has an age too: away for three event timers it is no longer taken for true.
    An amplifier that is enabled then shows Mode.NONE, its configured inputs are active, an encoder shows ALARMS_STALE.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from servod.common.errors import Unreachable

if TYPE_CHECKING:
    from servod.formats.config import AxisConfig

#: A control word in a synchronous RPDO acts at the next SYNC and is seen in the TPDO of the SYNC after it.
HANDSHAKE_SYNCS = 3
#: Age of feedback that never came; what was never heard is staler than any limit.
NEVER_CYCLES = 1_000_000
#: Bit of EncoderFeedback.alarms above the 16 of 0x6503: the alarm word itself has not come for its time.
ALARMS_STALE = 1 << 16


class DriveState(IntEnum):
    """States of the CiA 402 power drive system; UNKNOWN is what a status word that matches none decodes to."""

    UNKNOWN = 0
    NOT_READY_TO_SWITCH_ON = 1
    SWITCH_ON_DISABLED = 2
    READY_TO_SWITCH_ON = 3
    SWITCHED_ON = 4
    OPERATION_ENABLED = 5
    QUICK_STOP_ACTIVE = 6
    FAULT_REACTION_ACTIVE = 7
    FAULT = 8

    @property
    def powered(self) -> bool:
        """The drive function is enabled, so that torque may act: by command, or in the drive's own fault reaction."""
        return self in _POWERED

    @property
    def commanded(self) -> bool:
        """Powered, and by command: told to switch off or to stop, the drive has to leave these."""
        return self in _COMMANDED

    @property
    def off(self) -> bool:
        """At rest without power: where a shutdown is to end, and stays."""
        return self in _OFF

    @property
    def unpowered(self) -> bool:
        """No torque can act. UNKNOWN is neither powered nor unpowered."""
        return not (self in _POWERED or self is DriveState.UNKNOWN)


_OFF = (DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON, DriveState.FAULT)
_COMMANDED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_POWERED = (*_COMMANDED, DriveState.FAULT_REACTION_ACTIVE)


class Goal(IntEnum):
    """What is wanted of an amplifier. OFF removes the voltage at once; QUICK_STOP lets the drive stop by 0x605A."""

    OFF = 0
    READY = 1
    ENABLED = 2
    QUICK_STOP = 3


class Mode(IntEnum):
    """Modes of operation (CiA 402, 0x6060)."""

    NONE = 0
    PROFILE_POSITION = 1
    VELOCITY = 2
    PROFILE_VELOCITY = 3
    PROFILE_TORQUE = 4
    HOMING = 6
    INTERPOLATED_POSITION = 7
    CYCLIC_SYNC_POSITION = 8
    CYCLIC_SYNC_VELOCITY = 9
    CYCLIC_SYNC_TORQUE = 10


class Reason(IntFlag):
    """Why a goal is not reached yet; zero when it is. `REASON_TEXT` says each for people."""

    NONE = 0
    NO_FEEDBACK = 1
    STATE_UNKNOWN = 2
    IN_FAULT = 4
    NOT_READY = 8
    NO_VOLTAGE = 16
    MODE_NOT_SHOWN = 32
    HANDSHAKE = 64
    QUICK_STOP_HOLDS = 128
    HALTED = 256
    REMOTE_OFF = 512
    COMMANDS_MISSED = 1024


REASON_TEXT: dict[Reason, str] = {
    Reason.NO_FEEDBACK: "no fresh feedback from the drive (is the node operational?)",
    Reason.STATE_UNKNOWN: "the status word matches no state of CiA 402",
    Reason.IN_FAULT: "the drive is in fault; it needs an explicit fault reset",
    Reason.NOT_READY: "the drive is not ready to switch on",
    Reason.NO_VOLTAGE: "the drive has no supply voltage (status word bit 4)",
    Reason.MODE_NOT_SHOWN: "the drive does not show the mode of operation yet (0x6061)",
    Reason.HANDSHAKE: "waiting for the drive's answer",
    Reason.QUICK_STOP_HOLDS: "quick stop is active and holds (0x605A is 5 to 8)",
    Reason.HALTED: "halt is requested",
    Reason.REMOTE_OFF: "the drive does not take commands from the bus (status word bit 9)",
    Reason.COMMANDS_MISSED: "the command frames do not reach the drive (EMCY 0x8250)",
}


class DriveInput(IntFlag):
    """What the drive's inputs say that stops the axis (amplifier.inputs)."""

    ESTOP = 1
    STO = 2  # the circuit is open now
    STO_TOLD = 4  # the drive is in fault, and its error code says that STO was it


class AmplifierFeedback(NamedTuple):
    """What the amplifier said last, in SI units of the joint."""

    time_ns: int  # moment of the SYNC that sampled this feedback; 0 before the first
    age_cycles: int  # 0: of this cycle
    state: DriveState
    status_word: int
    mode: int  # 0x6061; -1 when not known, NONE when an enabled drive has not shown it for its time
    position_rad: float  # from the amplifier's own sensor, for plausibility only
    torque_nm: float  # torque actual value
    error_code: int  # 0x603F or EMCY, the last that was heard; 0 when none
    goal_reached: bool
    reasons: int  # bits of Reason
    inputs: int = 0  # bits of DriveInput that are active; all that are configured when they are not heard any more


class EncoderFeedback(NamedTuple):
    """What the encoder said last, in SI units of the joint."""

    time_ns: int  # moment of the SYNC that sampled this feedback; 0 before the first
    age_cycles: int  # 0: of this cycle
    position_rad: float
    velocity_rad_s: float
    alarms: int  # 0x6503 and ALARMS_STALE; 0 when none or not mapped


class AmplifierCommand(NamedTuple):
    """What the loop asks of the amplifier in one cycle."""

    goal: Goal
    torque_nm: float
    halt: bool = False
    reset_fault: bool = False
    release_brake: bool = False  # only of a brake by output; acts while the drive gives torque
    setpoint: float = 0.0  # joint position_rad (csp, pp) or velocity_rad_s (csv); not used in cst


class Amplifier(Protocol):
    """Cycle face of an amplifier driver; see the behaviour contract above."""

    receive_ids: tuple[int, ...]  # COB-IDs of its frames
    sync_frames: int  # synchronous frames it sends per SYNC
    ignored_frames: int  # too short, or not of this device; only grows

    def on_frame(self, can_id: int, data: bytes, time_ns: int) -> bool:
        """Take one frame; True when it was this cycle's synchronous feedback. Short frames are ignored and counted."""
        ...

    def read(self) -> AmplifierFeedback:
        """The feedback of this cycle; called once per cycle, after the frames."""
        ...

    def write(self, command: AmplifierCommand) -> tuple[int, bytes]:
        """Plan the control word and encode the command: (COB-ID, data) of the one frame to send."""
        ...


class Encoder(Protocol):
    """Cycle face of an encoder driver; see the behaviour contract above."""

    receive_ids: tuple[int, ...]
    sync_frames: int
    ignored_frames: int
    delay_s: float  # of the velocity against the position: half the differentiation span plus the filter's group delay

    def on_frame(self, can_id: int, data: bytes, time_ns: int) -> bool:
        """Take one frame; True when it was this cycle's synchronous feedback."""
        ...

    def read(self) -> EncoderFeedback:
        """The feedback of this cycle; called once per cycle, after the frames."""
        ...


#: Transmission types up to this one go by SYNC (CiA 301, 0x1800:2).
LAST_SYNCHRONOUS_TYPE = 240
#: By events, as the device's profile says.
EVENT_DRIVEN = 255


@dataclass(frozen=True)
class PdoEntry:
    """One mapped object of a PDO (CiA 301): index, subindex, length in bits."""

    index: int
    subindex: int
    bits: int

    @property
    def word(self) -> int:
        """The mapping entry as CiA 301 writes it: index << 16 | subindex << 8 | bits."""
        return self.index << 16 | self.subindex << 8 | self.bits


@dataclass(frozen=True)
class PdoMap:
    """One PDO as it shall stand in the device; `number` counts from 1, `receive` is seen from the device (RPDO).

    The event timer of an RPDO is its deadline: the device raises EMCY 8250 when the next one does not come in time.
    That of a TPDO that comes with every n-th SYNC is for a device that knows no such type: there it follows events.
    """

    receive: bool
    number: int
    cob_id: int
    transmission_type: int
    entries: tuple[PdoEntry, ...]
    event_timer_ms: int = 0
    inhibit_100us: int = 0

    @property
    def data_bytes(self) -> int:
        """Length of the frame's data."""
        return sum(e.bits for e in self.entries) // 8

    @property
    def syncs(self) -> int:
        """A TPDO comes with every SYNC (1), with every n-th, or follows events (0)."""
        synchronous = not self.receive and self.transmission_type <= LAST_SYNCHRONOUS_TYPE
        return max(1, self.transmission_type) if synchronous else 0

    @property
    def timer_ms(self) -> int:
        """What its event timer shall be: 0 with SYNC, where some devices would send by it as well."""
        return 0 if self.syncs else self.event_timer_ms


@dataclass(frozen=True)
class NodePlan:
    """All that the cycle face needs of one device; made by the set-up face, handed to the loop process as JSON."""

    driver: str
    node_id: int
    pdos: tuple[PdoMap, ...]
    facts: dict[str, Any] = field(default_factory=dict)  # scalings read from the device, options from the configuration


class SdoAbort(Unreachable):
    """The node refused an SDO transfer; `code` is CiA 301's abort code, the message says its meaning."""

    def __init__(self, message: str, code: int) -> None:
        self.code = code
        super().__init__(message)


class SdoAccess(Protocol):
    """What a driver's set-up face needs of the bus: confirmed reads and writes with time-out and abort codes."""

    def read(self, index: int, subindex: int = 0) -> int:
        """Upload an integer; raises Unreachable on time-out, SdoAbort on an abort."""
        ...

    def write(self, index: int, subindex: int, value: int) -> None:
        """Download an integer with the length that the EDS gives; raises as read does."""
        ...


class Setup(Protocol):
    """Set-up face of a driver: states what it wants (for the bus load), looks, and brings the device there."""

    def plan(self) -> NodePlan:
        """The wanted mapping, from the configuration alone, without touching the bus."""
        ...

    def inspect(self, sdo: SdoAccess) -> None:
        """Look whether the device may be set up now: reads alone, before anything else is sent to it.

        Raises Unreachable when it must be left alone (powered) or cannot be used (alarms).
        """
        ...

    def configure(self, sdo: SdoAccess) -> NodePlan:
        """Write parameters that are not PDO mapping, read scalings, and return the plan with its facts filled in."""
        ...


@runtime_checkable
class GuardedSetup(Setup, Protocol):
    """Set-up face of a drive that keeps limits by itself."""

    def guard_positions(self, sdo: SdoAccess, plan: NodePlan, joint_rad: float) -> list[str]:
        """Write its position limits, with the joint at `joint_rad` now; into the plan's facts. Notes."""
        ...

    def put_back(self, sdo: SdoAccess, plan: NodePlan) -> None:
        """Its limits as they were before `configure`; only while it has no torque."""
        ...


@runtime_checkable
class PresetSetup(Setup, Protocol):
    """Set-up face of a position sensor whose zero can be set in the device."""

    def position_rad(self, sdo: SdoAccess) -> float:
        """Where the joint stands."""
        ...

    def preset(self, sdo: SdoAccess, position_rad: float) -> int:
        """Make the present position of the joint read `position_rad`; the counts that were written.

        Only while no loop runs: the position jumps. Raises SdoAbort where the device refuses (in motion).
        """
        ...


@dataclass(frozen=True)
class Driver:
    """One row of the driver table: how to build both faces of a device."""

    kind: str  # "amplifier" or "encoder"
    setup: Callable[[AxisConfig], Setup]
    cyclic: Callable[[NodePlan], Amplifier | Encoder]
