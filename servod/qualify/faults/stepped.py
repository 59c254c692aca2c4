"""The stepped axis under test: one process, virtual time, every run the same."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from pathlib import Path

from servod.client.stepped import SteppedAxis, SteppedSession
from servod.common.errors import ServodError, Unreachable
from servod.common.faults import faults_in
from servod.common.shipped import shipped
from servod.common.yaml import validate
from servod.drivers.virtual.bus_faults import BusFault
from servod.drivers.virtual.drive_record import DriveRecord, read_drive_record
from servod.drivers.virtual.world import SteppedBus, SteppedWorld, VirtualAxisSettings
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import load_gains
from servod.qualify.faults.scenario import (
    PROVEN_BEFORE,
    PUNCTUAL,
    Nested,
    Recovery,
    Runs,
    Scenario,
    ScenarioStart,
    config_of,
    known_joint,
    merged,
    plant_of,
    shipped_config,
)
from servod.qualify.faults.under_test import MOTION, Observation
from servod.runtime.fieldbus.cia import NMT_ID
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import REFUSAL_TEXT, Op, Refusal
from servod.runtime.loop.wiring.findings import WiringOutcome

#: Samples of the drive's record for each millisecond: its commands, its own watch, its events.
_SAMPLES_PER_MS = 2.5
#: What a scenario takes besides its injections and its watch: bring-up, enabling, motion.
_OTHERWISE_MS = 8000.0
#: The drive's own record in the folder of a stepped axis.
RECORD_NAME = "drive.bin"
#: Whole half periods after the begin of its motion an axis is at its fastest, 1.3 rad/s.
_TO_THE_FASTEST_S = 0.5
#: The test of the wiring pushes when the joint feels this torque, about half of what friction takes; it begins by then.
_PUSHED_NM, _PUSHED_S = 0.03, 5.0


class SteppedUnderTest:
    """servod.qualify.faults.under_test.AxisUnderTest in virtual time; `folder` takes drive record and gain sets."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self.effects: Counter[Hashable] = Counter()
        self._folder, self._record_path = folder, folder / RECORD_NAME
        where = scenario.title
        settings = validate(scenario.settings, VirtualAxisSettings, f"{where}: settings")
        record = DriveRecord(self._record_path, _samples(scenario))
        self.world = SteppedWorld(settings, plant_of(scenario), record)
        config = config_of(scenario, merged(merged(shipped_config(), PROVEN_BEFORE), PUNCTUAL))
        self._config = known_joint(scenario, config, folder)
        self._foreign = self.world.connect(())
        self._axis: SteppedAxis | None = None
        self._refusal = ""

    @property
    def axis(self) -> SteppedAxis:
        """The axis as a client has it; it exists from the bring-up on."""
        assert self._axis is not None
        return self._axis

    @property
    def session(self) -> SteppedSession:
        """The master with its loop."""
        return self.axis.session

    @property
    def refusal(self) -> str:
        """Why a bring-up or a command was refused last; empty when none was."""
        return self._refusal

    def now_ns(self) -> int:
        """Virtual time."""
        return self.world.clock.now_ns()

    def start(self, start: ScenarioStart) -> None:
        """Bring up, enable and move, as far as `start` says."""
        if start is ScenarioStart.OFF:
            return
        self._bring_up()
        if start is ScenarioStart.PROVING:
            self._begin_proof()
            return
        if start in (ScenarioStart.ENABLED, ScenarioStart.MOVING):
            self.axis.enable()
        if start is ScenarioStart.MOVING:
            self.axis.begin(MOTION[Runs.STEPPED].reference)
        self.session.run(_TO_THE_FASTEST_S if start is ScenarioStart.MOVING else 0.1)

    def run(self, duration_s: float) -> None:
        """Advance; an axis that is off is brought up first, and a refusal is kept."""
        if self._axis is None and not self._refusal:
            try:
                self._bring_up()
            except ServodError as error:
                self._refusal = str(error)
        if self._axis is None:
            self.world.clock.sleep_until(self.now_ns() + round(duration_s * 1e9))
        else:
            self.session.run(duration_s)

    def bus_fault(self, fault: BusFault) -> None:
        """Ask the hub, as the loop's connection."""
        self._asker.inject(fault)

    def fault_effect(self, fault: BusFault) -> int:
        """Ask the hub, as the loop's connection."""
        return self._asker.happened(fault)

    def frame(self, can_id: int, data: bytes) -> None:
        """Send as somebody else on the bus."""
        self._foreign.send(can_id, data)

    def frame_effect(self, can_id: int, data: bytes) -> int:
        """An NMT command is heard by its node, any other frame by all."""
        if can_id != NMT_ID:
            return self._foreign.port.sent
        command, node_id = data
        return sum(node.nmt_taken[command] for node in self.world.devices.nodes if node.node_id == node_id)

    def sdo_write(self, node_id: int, index: int, subindex: int, value: int) -> bool:
        """Write past the bus, straight into the node's dictionary."""
        return self.world.write(node_id, index, subindex, value)

    def command(self, op: Op, arguments: Sequence[float] = ()) -> bool:
        """Give the loop a command; False when it was refused, which is kept."""
        refusal = self.session.send(op, arguments)
        if refusal != Refusal.DONE:
            self._refusal = REFUSAL_TEXT[refusal]
        return refusal == Refusal.DONE

    def observe(self) -> Observation:
        """What is seen now."""
        samples = read_drive_record(self._record_path)
        if self._axis is None:
            return Observation(samples, AxisState.DISABLED.name, frozenset(), self._refusal)
        axis, records = self.session.cycle.axis, self.session.records
        state = axis.state
        if self.session.loop_dead:  # nobody is left to say it: the drive does
            state = AxisState.ENABLED if samples[-1].state is DriveState.OPERATION_ENABLED else AxisState.DISABLED
        latched = frozenset(fault.code for fault in faults_in(axis.latched))
        proof = self.session.proof
        says = None if proof is None else WiringOutcome(int(proof.finding))
        errors = frozenset(record.drive_error for record in records) - {0}
        stopping = self.session.stopping
        stated = None if stopping is None else stopping.document()
        return Observation(samples, state.name, latched, self._refusal, None, says, errors, stated)

    def recover(self, recovery: Recovery) -> bool:
        """Do what a person would do, and hold for a tenth of a second."""
        try:
            if recovery is Recovery.RESTART:
                self._bring_up()
            if recovery is not Recovery.NONE:
                self.axis.enable(recovery is Recovery.RESET_FAULT)
        except ServodError as error:
            self._refusal = str(error)
            return False
        self.session.run(0.1)
        return self.axis.status().enabled

    def configure(self, over: Nested) -> bool:
        """Lay keys over the configuration; the next bring-up reads them. True when that changed it. Raises BadInput."""
        before = self._config
        base = before.model_dump(mode="json", exclude_none=True)
        self._config = validate(merged(base, over), AxisConfig, "configure")
        return self._config != before

    def close(self) -> None:
        """Leave the bus."""
        if self._axis is not None:
            self.session.close()

    @property
    def _asker(self) -> SteppedBus:
        """Before the bring-up there is no loop."""
        return self._foreign if self._axis is None else self.session.loop_bus

    def _begin_proof(self) -> None:
        """Enable, up to the moment at which the test of the wiring pushes the joint."""
        self.command(Op.ENABLE)
        until_ns = self.now_ns() + round(_PUSHED_S * 1e9)
        while abs(self.world.truth().torque_nm) < _PUSHED_NM:
            self.session.run(0.001)
            if self.now_ns() > until_ns:
                raise Unreachable("the test of the wiring does not push: is wiring_proof.enabled set?")

    def _bring_up(self) -> None:
        self.close()
        gains = load_gains(shipped("gains/demo_pd.yaml"))
        session = SteppedSession(self._config, self.world, gains.law.number, gains.pack())
        self._axis = SteppedAxis(session, self._folder, gains)


def _samples(scenario: Scenario) -> int:
    """Capacity of the drive's record: all of the scenario, and little more, since it is read as a whole."""
    all_of_it = [*scenario.inject, *scenario.mend]
    longest_ms = sum(i.at_ms for i in all_of_it) + scenario.watch_ms + scenario.mend_ms + _OTHERWISE_MS
    return round(longest_ms * _SAMPLES_PER_MS)
