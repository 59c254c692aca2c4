"""An axis under test: what every world (stepped, processes, guest) offers to scenarios, actions and judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from servod.campaign.scenario import Recovery, Runs, Start
from servod.commands import Op
from servod.drivers.virtual.bus_faults import BusFault
from servod.drivers.virtual.drive_record import DriveSample
from servod.errors import FaultCode
from servod.wiring_proof import Finding

AMPLIFIER, ENCODER = 1, 2


class Sine(NamedTuple):
    """The motion of an axis that starts moving."""

    amplitude_rad: float
    frequency_hz: float


#: In virtual time a motion may be faster than on a machine that others use too.
MOTION = {Runs.STEPPED: Sine(0.1, 2.0), Runs.PROCESSES: Sine(0.2, 1.0), Runs.GUEST: Sine(0.2, 1.0)}


@dataclass(frozen=True)
class Observation:
    """What was seen after a scenario, before anything was done to recover.

    `samples`: the drive's own record; `axis`: name of the axis state; `latched`: the faults that the user is shown;
    `refusal`: message with which bring-up or command was refused, "" when none was; `lost_records`: cycles without a
    record, None where no recorder runs (in virtual time the rows do not leave the process); `says`: how the last proof
    of the wiring ended, None where none was told; `drive_errors`: the drive's error codes in the cycle records.
    """

    samples: list[DriveSample]
    axis: str
    latched: frozenset[FaultCode]
    refusal: str
    lost_records: int | None = None
    says: Finding | None = None
    drive_errors: frozenset[int] = frozenset()


class AxisUnderTest(Protocol):
    """One virtual axis with its master; time is that of the drive's record."""

    def now_ns(self) -> int:
        """Present time."""

    def start(self, start: Start) -> None:
        """Bring the axis to where the scenario begins. Raises ServodError when it does not get there."""

    def run(self, duration_s: float) -> None:
        """Let time pass; an axis that is still off tries its bring-up at the beginning of the first run."""

    def bus_fault(self, fault: BusFault) -> None:
        """Ask the hub for a fault of the bus; participant MYSELF is the loop."""

    def frame(self, can_id: int, data: bytes) -> None:
        """Send a frame as a foreign participant, raw."""

    def sdo_write(self, node_id: int, index: int, subindex: int, value: int) -> None:
        """Write an object of a node, as the vendor's service tool would."""

    def command(self, op: Op, arguments: Sequence[float] = ()) -> None:
        """Give the loop a command; a refusal is kept for `observe`."""

    def observe(self) -> Observation:
        """What is seen now."""

    def recover(self, recovery: Recovery) -> bool:
        """Do what a person would do; True when the axis is enabled and holds without a fault afterwards."""

    def close(self) -> None:
        """End everything that runs."""
