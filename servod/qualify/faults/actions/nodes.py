"""Actions on nodes: network management and objects of their dictionaries."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field, model_validator

from servod.drivers.virtual.amplifier import AMPLIFIER_EDS
from servod.drivers.virtual.dictionary import DeviceDictionary, Entry
from servod.drivers.virtual.encoder import ENCODER_EDS
from servod.qualify.faults.actions.base import NODE_ID, InjectionAction, Who
from servod.qualify.faults.scenario import Loss
from servod.runtime.fieldbus.cia import NMT_ID, NmtCommand

if TYPE_CHECKING:
    from servod.qualify.faults.under_test import AxisUnderTest


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
