"""An axis under test: the axis as any client has it, and what a scenario may do to it in every world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from servod.client.axis import AxisClient, ReferenceMotion
from servod.common.faults import FaultCode
from servod.drivers.virtual.bus_faults import BusFault
from servod.drivers.virtual.drive_record import DriveSample
from servod.formats.stopping import StoppingStatus
from servod.qualify.faults.scenario import Recovery, Runs, ScenarioStart
from servod.runtime.loop.wiring.findings import WiringOutcome

AMPLIFIER, ENCODER = 1, 2


class StartMotion(NamedTuple):
    """The sine of an axis that starts moving."""

    amplitude_rad: float
    frequency_hz: float

    @property
    def reference(self) -> ReferenceMotion:
        """For longer than any scenario."""
        return ReferenceMotion.sine(self.amplitude_rad, self.frequency_hz, 600.0)


#: In virtual time a motion may be faster than on a machine that others use too. There it is larger: a joint that strays
#: by what such a machine does to it is far from one that stands.
MOTION = {
    Runs.STEPPED: StartMotion(0.1, 2.0),
    Runs.PROCESSES: StartMotion(0.3, 0.7),
    Runs.GUEST: StartMotion(0.6, 0.5),
}


@dataclass(frozen=True)
class Observation:
    """What was seen after a scenario, before anything was done to recover.

    `samples`: the drive's own record; `axis`: name of the axis state; `latched`: the faults that the user is shown;
    `refusal`: message with which bring-up or command was refused, "" when none was; `lost_records`: cycles without a
    record, None where no recorder runs (in virtual time the rows do not leave the process); `says`: how the last proof
    of the wiring ended, None where none was told; `drive_errors`: the drive's error codes in the cycle records;
    `stated`: the stop that servod stated (`stopping` of the status), None where it stated none.
    """

    samples: list[DriveSample]
    axis: str
    latched: frozenset[FaultCode]
    refusal: str
    lost_records: int | None = None
    says: WiringOutcome | None = None
    drive_errors: frozenset[int] = frozenset()
    stated: StoppingStatus | None = None


class AxisUnderTest(Protocol):
    """One virtual axis with its master; time is that of the drive's record.

    `effects` counts how often actions that see their effect at once took effect, by their mark
    (servod.qualify.faults.actions.base).
    """

    effects: Counter[Hashable]

    @property
    def axis(self) -> AxisClient:
        """The axis as a client has it; it exists from the bring-up on."""

    def now_ns(self) -> int:
        """Present time."""

    def start(self, start: ScenarioStart) -> None:
        """Bring the axis to where the scenario begins. Raises ServodError when it does not get there."""

    def run(self, duration_s: float) -> None:
        """Let time pass; an axis that is still off tries its bring-up at the beginning of the first run."""

    def bus_fault(self, fault: BusFault) -> None:
        """Ask the hub for a fault of the bus; participant MYSELF is the loop."""

    def fault_effect(self, fault: BusFault) -> int:
        """How often what `fault` asks for took effect so far, as the hub counts it."""

    def frame(self, can_id: int, data: bytes) -> None:
        """Send a frame as a foreign participant, raw."""

    def frame_effect(self, can_id: int, data: bytes) -> int:
        """How often such a frame of a foreign participant was heard so far."""

    def sdo_write(self, node_id: int, index: int, subindex: int, value: int) -> bool:
        """Write an object of a node past the bus, by a plug of its own; True when the node has taken it."""

    def observe(self) -> Observation:
        """What is seen now."""

    def recover(self, recovery: Recovery) -> bool:
        """Do what a person would do; True when the axis is enabled and holds without a fault afterwards."""

    def close(self) -> None:
        """End everything that runs."""
