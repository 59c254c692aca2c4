"""Actions on frames, wires and nodes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field, model_validator

from servod.drivers.virtual.amplifier import AMPLIFIER_EDS
from servod.drivers.virtual.bus_faults import ANY_ID, MYSELF, BusFault, FaultKind
from servod.drivers.virtual.dictionary import DeviceDictionary, Entry
from servod.drivers.virtual.encoder import ENCODER_EDS
from servod.qualify.faults.actions.base import NODE_ID, InjectionAction, Who
from servod.qualify.faults.scenario import Loss
from servod.qualify.faults.under_test import AMPLIFIER, ENCODER
from servod.runtime.fieldbus.cia import HEARTBEAT_BASE, NMT_ID, RPDO_BASE, SYNC_ID, TPDO_BASE, NmtCommand

if TYPE_CHECKING:
    from servod.qualify.faults.under_test import AxisUnderTest

_ALWAYS = 1_000_000_000
#: Shorter gaps are ridden over: limits.stale_cycles of the shipped configuration, and about what the drive waits for
#: commands before it looks after itself [ms, and cycles at 1 kHz].
_FEEDBACK_GAP_MS, MASTER_GAP_MS = 20, 50
#: So many frames in a row are destroyed until the sender's controller is bus-off (8 each, 256 in all).
_BUS_OFF_FRAMES = 32


class FrameName(StrEnum):
    """The frames of one cycle by what they carry."""

    ANY = "any"
    SYNC = "sync"
    TORQUE = "torque"  # RPDO1 of the amplifier: control word and torque
    DRIVE_FEEDBACK = "drive_feedback"  # TPDO1 of the amplifier
    DRIVE_INPUTS = "drive_inputs"  # TPDO2 of the amplifier: mode, error code, digital inputs
    ENCODER_FEEDBACK = "encoder_feedback"  # TPDO2 of the encoder
    MASTER_HEARTBEAT = "master_heartbeat"
    AMPLIFIER_HEARTBEAT = "amplifier_heartbeat"
    ENCODER_HEARTBEAT = "encoder_heartbeat"


CAN_ID = {
    FrameName.ANY: ANY_ID,
    FrameName.SYNC: SYNC_ID,
    FrameName.TORQUE: RPDO_BASE[0] + AMPLIFIER,
    FrameName.DRIVE_FEEDBACK: TPDO_BASE[0] + AMPLIFIER,
    FrameName.DRIVE_INPUTS: TPDO_BASE[1] + AMPLIFIER,
    FrameName.ENCODER_FEEDBACK: TPDO_BASE[1] + ENCODER,
    FrameName.MASTER_HEARTBEAT: HEARTBEAT_BASE + 126,
    FrameName.AMPLIFIER_HEARTBEAT: HEARTBEAT_BASE + AMPLIFIER,
    FrameName.ENCODER_HEARTBEAT: HEARTBEAT_BASE + ENCODER,
}


class FrameFault(StrEnum):
    """What happens to a frame."""

    DROP = "drop"  # it reaches nobody
    DESTROY = "destroy"  # an error frame hits it, the controller repeats it
    LATE = "late"  # it arrives `detail` tenths of a millisecond later
    DUPLICATE = "duplicate"  # it arrives twice
    REORDER = "reorder"  # it arrives after the next one of its kind
    SHORTEN = "shorten"  # its last `detail` bytes are missing
    FLIP = "flip"  # its bit `detail` is wrong, and the check sum did not show it


_KIND = {
    FrameFault.DROP: FaultKind.DROP,
    FrameFault.DESTROY: FaultKind.CORRUPT,
    FrameFault.LATE: FaultKind.LATE,
    FrameFault.DUPLICATE: FaultKind.DUPLICATE,
    FrameFault.REORDER: FaultKind.REORDER,
    FrameFault.SHORTEN: FaultKind.SHORTEN,
    FrameFault.FLIP: FaultKind.FLIP,
}


class BusAction(InjectionAction):
    """An action that the hub carries out, and counts."""

    @abstractmethod
    def request(self) -> BusFault:
        """What the hub is asked for."""

    def mark(self) -> Hashable:
        """The kind of fault with what it hits."""
        return self.request().concerns

    def effect(self, axis: AxisUnderTest) -> int:
        """As the hub counts it."""
        return axis.fault_effect(self.request())

    def apply(self, axis: AxisUnderTest) -> None:
        """Ask the hub for it."""
        axis.bus_fault(self.request())


_TAKEN_AWAY = (FrameFault.DROP, FrameFault.SHORTEN)
#: What of the axis hangs on a kind of frame, and how many of them may be missing.
_CARRIES = {
    FrameName.ANY: (Loss.FEEDBACK, _FEEDBACK_GAP_MS),
    FrameName.SYNC: (Loss.MASTER, _FEEDBACK_GAP_MS),
    FrameName.TORQUE: (Loss.MASTER, MASTER_GAP_MS),
    FrameName.DRIVE_FEEDBACK: (Loss.FEEDBACK, _FEEDBACK_GAP_MS),
    FrameName.ENCODER_FEEDBACK: (Loss.FEEDBACK, _FEEDBACK_GAP_MS),
    FrameName.MASTER_HEARTBEAT: (Loss.MASTER, 1),
}


class Frames(BusAction):
    """The next `count` frames of a kind are hit; without a count all that follow."""

    traceless: ClassVar[str] = "no frame was struck"

    of: FrameName
    fault: FrameFault
    count: int | None = Field(None, ge=1)
    detail: int = Field(0, ge=0, le=255)

    def wanted(self) -> int:
        """All of the count."""
        return self.count or 1

    def loss(self) -> Loss:
        """Frames that do not arrive take what they carry, when there are enough of them."""
        loss, gap = _CARRIES.get(self.of, (Loss.NONE, 0))
        count = self.count or _ALWAYS
        lost = count > gap if self.fault in _TAKEN_AWAY else False
        return loss if lost or (self.fault is FrameFault.DESTROY and count >= _BUS_OFF_FRAMES) else Loss.NONE

    def request(self) -> BusFault:
        """Arm the fault in the hub."""
        return BusFault(_KIND[self.fault], CAN_ID[self.of], self.count or _ALWAYS, self.detail)


class FramesPass(BusAction):
    """What hit frames is taken away: all pass unhurt again."""

    traceless: ClassVar[str] = "no fault was taken back"

    def request(self) -> BusFault:
        """Disarm the faults in the hub."""
        return BusFault(FaultKind.CLEAR)


def _loss_of(who: Who, gap_ms: float) -> Loss:
    """What is lost with a participant: the encoder's feedback, or the way of commands to the drive."""
    if who is Who.ENCODER:
        return Loss.FEEDBACK if gap_ms > _FEEDBACK_GAP_MS else Loss.NONE
    return Loss.MASTER if gap_ms > MASTER_GAP_MS else Loss.NONE


class Silence(BusAction):
    """A participant neither sends nor hears for a while: a cut wire, a node without supply."""

    traceless: ClassVar[str] = "no frame was lost"

    who: Who
    for_ms: int = Field(ge=1)

    def loss(self) -> Loss:
        """Of the participant, for its time."""
        return _loss_of(self.who, self.for_ms)

    def request(self) -> BusFault:
        """Cut it off."""
        return BusFault(FaultKind.SILENT, amount=self.for_ms, participant=NODE_ID.get(self.who, MYSELF))


class BusOff(BusAction):
    """A participant's CAN controller goes bus-off."""

    traceless: ClassVar[str] = "no controller went bus-off"

    who: Who

    def loss(self) -> Loss:
        """Of the participant; its nodes are not taken up again by themselves."""
        return _loss_of(self.who, _ALWAYS)

    def request(self) -> BusFault:
        """Drive its error counter over the limit."""
        return BusFault(FaultKind.BUS_OFF, participant=NODE_ID.get(self.who, MYSELF))


class QueueStands(BusAction):
    """A participant hears, but cannot send: its frames wait in the transmit queue until that is full (ENOBUFS)."""

    traceless: ClassVar[str] = "no frame had to wait"

    who: Who
    for_ms: int = Field(ge=1)

    def loss(self) -> Loss:
        """Of what the participant sends, for its time."""
        return _loss_of(self.who, self.for_ms)

    def request(self) -> BusFault:
        """Stop its controller from sending."""
        return BusFault(FaultKind.STUCK, amount=self.for_ms, participant=NODE_ID.get(self.who, MYSELF))


class InterfaceDown(BusAction):
    """The loop's interface goes down, and is up again after a while."""

    traceless: ClassVar[str] = "the interface did not go down"

    for_ms: int = Field(ge=1)

    def loss(self) -> Loss:
        """However short: the connection is gone with the interface."""
        return Loss.MASTER

    def request(self) -> BusFault:
        """Take it down."""
        return BusFault(FaultKind.DOWN, amount=self.for_ms)


class Babble(BusAction):
    """A further participant sends one identifier again and again; without `each_ms` as often as the bus takes it."""

    traceless: ClassVar[str] = "no frame of the babbler was carried"

    can_id: int = Field(ge=0, le=0x7FF)
    for_ms: int = Field(ge=1)
    each_ms: int = Field(0, ge=0, le=20)

    def loss(self) -> Loss:
        """All there is, when it wins every arbitration and leaves no gap."""
        starves = not self.each_ms and self.can_id < CAN_ID[FrameName.SYNC] and self.for_ms > MASTER_GAP_MS
        return Loss.MASTER if starves else Loss.NONE

    def request(self) -> BusFault:
        """Let it begin."""
        return BusFault(FaultKind.BABBLE, self.can_id, self.for_ms, self.each_ms)


class SecondNode(BusAction):
    """A second node with the same id is switched on."""

    traceless: ClassVar[str] = "the second node sent nothing"

    who: Who

    def request(self) -> BusFault:
        """Switch it on."""
        return BusFault(FaultKind.TWIN, participant=NODE_ID[self.who])


BUS_ACTIONS: dict[str, type[InjectionAction]] = {
    "frames": Frames,
    "frames_pass": FramesPass,
    "silence": Silence,
    "bus_off": BusOff,
    "queue_stands": QueueStands,
    "interface_down": InterfaceDown,
    "babble": Babble,
    "second_node": SecondNode,
}


# --- Nodes -----------------------------------------------------------------------------------------------------------
# Actions on nodes: network management and objects of their dictionaries.


class NmtName(StrEnum):
    """NMT commands (CiA 301, 7.2.8.3.1)."""

    START = "start"
    STOP = "stop"
    PRE_OPERATIONAL = "pre_operational"
    RESET_NODE = "reset_node"
    RESET_COMMUNICATION = "reset_communication"


class FrameAction(InjectionAction):
    """An action that is one frame of a stranger."""

    traceless: ClassVar[str] = "nobody heard the frame"

    @abstractmethod
    def content(self) -> tuple[int, bytes]:
        """Identifier and data."""

    def mark(self) -> Hashable:
        """The frame."""
        return self.content()

    def effect(self, axis: AxisUnderTest) -> int:
        """How often it was heard."""
        return axis.frame_effect(*self.content())

    def apply(self, axis: AxisUnderTest) -> None:
        """Send it."""
        axis.frame(*self.content())


class Nmt(FrameAction):
    """Somebody sends an NMT command: what a node does by itself when its supply fails, or a second master does."""

    who: Who
    command: NmtName

    def loss(self) -> Loss:
        """Outside operational a node sends and takes no PDO; the master hears of it by its silence."""
        return Loss.NONE if self.command is NmtName.START else Loss.FEEDBACK

    def content(self) -> tuple[int, bytes]:
        """CiA 301, 7.2.8.3.1."""
        return NMT_ID, bytes([NmtCommand[self.command.name], NODE_ID[self.who]])


#: The vendor's objects that take something from the axis when they are not 0: node, index, subindex.
_TAKES = {
    (Who.AMPLIFIER, 0x2000, 4): Loss.MASTER,  # local control: no command from the bus counts
    (Who.ENCODER, 0x2000, 1): Loss.FEEDBACK,  # its position is declared invalid
    (Who.ENCODER, 0x2000, 3): Loss.FEEDBACK,  # its position is frozen
}


class ObjectWrite(InjectionAction):
    """An object of a node changes: the vendor's objects 0x2000 put causes of faults into the virtual nodes."""

    traceless: ClassVar[str] = "the node did not take the value"

    who: Who
    index: int = Field(ge=0x1000, le=0xFFFF)
    subindex: int = Field(0, ge=0, le=254)
    value: int

    @model_validator(mode="after")
    def _fits(self) -> ObjectWrite:
        entry = _entry(self.who, self.index, self.subindex)
        if entry is None:
            raise ValueError(f"index and subindex of an object in the EDS file of the {self.who}")
        if not entry.low <= self.value <= entry.high:
            raise ValueError(f"value {entry.low} to {entry.high} for 0x{self.index:04X}:{self.subindex}")
        return self

    def loss(self) -> Loss:
        """By the object, when it is set."""
        return _TAKES.get((self.who, self.index, self.subindex), Loss.NONE) if self.value else Loss.NONE

    def mark(self) -> Hashable:
        """The object."""
        return type(self), self.who, self.index, self.subindex

    def apply(self, axis: AxisUnderTest) -> None:
        """Write it."""
        self.took(axis, axis.sdo_write(NODE_ID[self.who], self.index, self.subindex, self.value))


@cache
def _objects(who: Who) -> DeviceDictionary:
    """The objects of one node as they are before anything is written; not for writing."""
    return DeviceDictionary(AMPLIFIER_EDS if who is Who.AMPLIFIER else ENCODER_EDS)


def _entry(who: Who, index: int, subindex: int) -> Entry | None:
    """The integer that can be written there."""
    if who is Who.LOOP or not _objects(who).has(index, subindex):
        return None
    entry = _objects(who).entry(index, subindex)
    return entry if entry.bits else None


class ForeignFrame(FrameAction):
    """Somebody sends a frame: `data` is written as hexadecimal bytes."""

    can_id: int = Field(ge=0, le=0x7FF)
    data: str = Field("", pattern=r"^([0-9A-Fa-f]{2}){0,8}$")

    def content(self) -> tuple[int, bytes]:
        """As it is written."""
        return self.can_id, bytes.fromhex(self.data)


NODE_ACTIONS: dict[str, type[InjectionAction]] = {
    "nmt": Nmt,
    "object_write": ObjectWrite,
    "foreign_frame": ForeignFrame,
}
