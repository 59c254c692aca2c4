"""The axis under test as processes: daemon, loop and virtual axis on the wall clock, on a wire of their own.

The same axis runs on the hub's socket and on SocketCAN. The drive's record judges, whoever was killed; the user's side
is what `status` says, and the daemon's log, which is left when nobody answers.
"""

from __future__ import annotations

import re
import signal
import time
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from typing import Any

import yaml

from servod.client.control import ControlClient
from servod.client.processes import last_core, own_group
from servod.client.under_daemon import DaemonAxis
from servod.common.errors import ServodError, Unreachable
from servod.common.faults import FaultCode
from servod.common.shipped import shipped
from servod.common.units import NS_PER_US
from servod.common.yaml import validate
from servod.drivers.virtual.bus_faults import BusFault
from servod.drivers.virtual.drive_record import DriveSample
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.model.axis_model import axis_model_yaml
from servod.formats.protocol import Verb
from servod.formats.stopping import StoppingStatus
from servod.qualify.faults.evidence import lost_records, wait_for_rows
from servod.qualify.faults.machine import Machine, Process
from servod.qualify.faults.scenario import (
    Nested,
    Recovery,
    Scenario,
    ScenarioStart,
    config_of,
    known_joint,
    merged,
    plant_of,
    shipped_config,
)
from servod.qualify.faults.under_test import MOTION, Observation
from servod.qualify.faults.wire import HubWire, Wire, at_the_hub, send_heard
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState

#: The joint moves when its torque is so large [N*m]: enough to lose.
_MOVING_NM, _START_S = 0.01, 20.0
#: The judge continues the motion of before the injection: so many periods it must have seen of it, the first third of
#: which it leaves out.
_SHOWN_PERIODS = 1.5
_LOGGED = re.compile(r"fault ([A-Z_]+) \(")
_ASKS_TO_END = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_FAULTED = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)


class ProcessAxis:
    """servod.qualify.faults.under_test.AxisUnderTest on the wall clock.

    `folder` takes everything that is written; `over` is laid over the configuration before the scenario's own keys;
    `machine` has the processes, where they are not to be made here on the hub's socket.
    """

    def __init__(
        self, scenario: Scenario, folder: Path, machine: Machine | None = None, over: Nested | None = None
    ) -> None:
        """Raises BadInput for a scenario's keys."""
        self.folder, self.machine = folder, machine or Machine(folder, HubWire(folder), scenario.waits)
        self.wire = self.machine.wire
        config = config_of(scenario, merged(_base(folder, self.wire), over or {}))
        self.config = known_joint(scenario, config, folder)
        settings = validate(scenario.settings, VirtualAxisSettings, f"{scenario.title}: settings")
        (folder / "settings.yaml").write_text(yaml.safe_dump(settings.model_dump(mode="json")))
        (folder / "plant.yaml").write_text(axis_model_yaml(plant_of(scenario)))
        self.machine.config.write_text(yaml.safe_dump(self.config.model_dump(mode="json")))
        self.effects: Counter[Hashable] = Counter()
        self._motion = MOTION[scenario.runs]
        self._client: ControlClient | None = None
        self._hit_ns: int | None = None
        self._asked_to_end = self._off = self._up = False
        self.refusal = ""
        self._stated: StoppingStatus | None = None
        self.stopped_client: Popen[bytes] | None = None

    def now_ns(self) -> int:
        """The clock of the drive's record."""
        return time.monotonic_ns()

    def start(self, start: ScenarioStart) -> None:
        """Start the processes, enable and move, as far as `start` says."""
        self.machine.start_virtual_axis()
        self._off = start is ScenarioStart.OFF
        if self._off:
            return
        self.machine.start_daemon()
        self._up = True
        if start in (ScenarioStart.ENABLED, ScenarioStart.MOVING):
            self.axis.enable()
        if start is ScenarioStart.MOVING:
            self.axis.begin(self._motion.reference)
            self._wait_until(self._moves, "the axis does not move")
            time.sleep(_SHOWN_PERIODS / self._motion.frequency_hz)
        self._wait_until(self._recorded, "the recorder writes nothing")
        self._stated = self.client.call(Verb.STATUS)["stopping"]

    def run(self, duration_s: float) -> None:
        """Let time pass; an axis that is off is brought up first, and a refusal is kept."""
        if self._off:
            self._off = False
            try:
                self.machine.start_daemon()
                self._up = True
            except ServodError as error:
                self.refusal = str(error)
        time.sleep(duration_s)

    def bus_fault(self, fault: BusFault) -> None:
        """Ask the hub, as somebody else than the loop. Raises BadInput for what only the loop itself could ask for."""
        with at_the_hub(self.wire, fault) as foreign:
            foreign.inject(fault)
            foreign.happened(fault)  # answered behind it: who leaves at once takes what still waits with him

    def fault_effect(self, fault: BusFault) -> int:
        """Ask the hub, as somebody else than the loop."""
        with at_the_hub(self.wire, fault) as foreign:
            return foreign.happened(fault)

    def frame(self, can_id: int, data: bytes) -> None:
        """Send as somebody else on the bus."""
        self.effects[can_id, data] += send_heard(self.wire, can_id, data)

    def frame_effect(self, can_id: int, data: bytes) -> int:
        """As it was heard when it was sent."""
        return self.effects[can_id, data]

    def sdo_write(self, node_id: int, index: int, subindex: int, value: int) -> bool:
        """Ask the hub, which is in one process with the nodes; on the bus it would be a foreign SDO."""
        fault = BusFault.write(node_id, index, subindex, value)
        with at_the_hub(self.wire, fault) as foreign:
            before = foreign.happened(fault)
            foreign.inject(fault)
            return foreign.happened(fault) > before

    def call(self, verb: Verb, **args: Any) -> dict[str, Any]:
        """Ask the daemon for anything; a refusal is kept, and gives nothing."""
        try:
            return self.client.call(verb, **args)
        except ServodError as error:
            self.refusal = str(error)
            return {}

    def signal(self, who: Sequence[Process], number: signal.Signals) -> bool:
        """Send a signal; from the first that kills on, records may be missing. False when one was gone already."""
        there = all(map(self.machine.alive, who))
        if number is not signal.SIGCONT and set(who) & {Process.DAEMON, Process.LOOP}:
            self._hit_ns = self._hit_ns or self.now_ns()
        self._asked_to_end |= Process.DAEMON in who and number in _ASKS_TO_END
        self.machine.send(who, number)
        return there

    def restart_daemon(self) -> None:
        """As the service manager does it: SIGTERM, wait, start."""
        self.signal([Process.DAEMON], signal.SIGTERM)
        self._expect_exit()
        self._asked_to_end = False
        self.leave()
        self.machine.start_daemon()
        self._hit_ns = None  # the new one is whole

    def second_daemon(self) -> None:
        """Start another daemon with the same configuration; what it says and its exit code are the refusal."""
        log = self.folder / "second.log"
        code = self.machine.daemon_process(log).wait(20.0)
        lines = log.read_text(errors="replace").strip().splitlines()
        self.refusal = f"exit code {code} after {len(lines)} line: {lines[-1] if lines else ''}"

    def observe(self) -> Observation:
        """What is seen now."""
        if self._asked_to_end:
            self._expect_exit()
        samples = self.machine.drive_samples()
        axis, shown, overrun = self._shown(samples)
        logged = {FaultCode[name] for name in _LOGGED.findall(self.machine.daemon_log())}
        lost = self._lost_records() + overrun if self._up and self.config.recorder.always else None
        return Observation(samples, axis, frozenset(shown | logged), self.refusal, lost, stated=self._stated)

    def recover(self, recovery: Recovery) -> bool:
        """Do what a person would do, and hold for a tenth of a second."""
        try:
            if recovery is Recovery.RESTART:
                self._restart_what_ended()
            if recovery is not Recovery.NONE:
                self.axis.enable(recovery is Recovery.RESET_FAULT)
            time.sleep(0.1)
            return self.axis.status().enabled
        except ServodError as error:
            self.refusal = str(error)
            return False

    def close(self) -> None:
        """End all processes."""
        self.leave()
        self.machine.close()

    @property
    def axis(self) -> DaemonAxis:
        """The axis as a client has it. Raises Unreachable."""
        return DaemonAxis(self.client)

    @property
    def client(self) -> ControlClient:
        """The connection that commands. Raises Unreachable."""
        if self._client is None:
            self._client = self.machine.client()
        return self._client

    def leave(self) -> None:
        """Give the right to command back, so that somebody else may have it."""
        if self._client is not None:
            self._client.close()
        self._client = None

    def _shown(self, samples: list[DriveSample]) -> tuple[str, set[FaultCode], int]:
        """State, faults and overrun records by `status`; without a daemon only what the drive shows."""
        try:
            with self.machine.client() as client:
                status = client.call(Verb.STATUS)
        except Unreachable:
            last = samples[-1].state if samples else DriveState.UNKNOWN
            enabled = AxisState.ENABLED if last is DriveState.OPERATION_ENABLED else AxisState.DISABLED
            return (AxisState.FAULT if last in _FAULTED else enabled).name, set(), 0
        faults = {FaultCode[fault["code"]] for fault in status["faults"]}
        return status["axis"]["state"], faults, int(status["timing"]["records_lost"])

    def _lost_records(self) -> int:
        """Up to now where the daemon lives, and up to where it was hit; one that ended by itself did when it did."""
        lives = self.machine.alive(Process.DAEMON)
        due_ns = self.now_ns() if lives and self._hit_ns is None else self._hit_ns
        folder = self.config.recorder.directory
        if lives and due_ns is not None:
            wait_for_rows(folder, due_ns)
        return lost_records(folder, self.config.cycle.period_us * NS_PER_US, due_ns)

    def _expect_exit(self) -> None:
        """A daemon that was asked to end does so with 0."""
        try:
            code = self.machine.wait(Process.DAEMON, 10.0)
        except TimeoutExpired:
            self.refusal = "the daemon did not end when it was asked to"
        else:
            self.refusal = self.refusal if code == 0 else f"the daemon ended with exit code {code}"

    def _restart_what_ended(self) -> None:
        self.leave()
        if not self.machine.alive(Process.VIRTUAL_AXIS):
            self.machine.start_virtual_axis()
        if self.machine.alive(Process.DAEMON):
            self.machine.stop_daemon()
        self.machine.start_daemon()

    def _moves(self) -> bool:
        return abs(self.machine.drive_samples()[-1].torque_nm) >= _MOVING_NM

    def _recorded(self) -> bool:
        """There are rows to lose."""
        recorder = self.client.call(Verb.STATUS)["recorder"]
        return bool(recorder["records"]) or not self.config.recorder.always

    def _wait_until(self, reached: Callable[[], bool], otherwise: str) -> None:
        deadline = time.monotonic() + _START_S
        while not reached():
            if time.monotonic() > deadline:
                raise Unreachable(otherwise)
            time.sleep(0.03)


def _base(folder: Path, wire: Wire) -> Nested:
    """The shipped configuration in `folder`; limits on lateness are those of a machine that others use too."""
    base = shipped_config()
    del base["metrics"]
    own = {
        "bus": wire.bus_config(),
        "cycle": {"feedback_timeout_us": 800, "cpu": last_core()},
        "limits": {"stale_cycles": 50, "late_cycles": 200},
        # Its scenarios are stepped ones: it measures the joint, and a machine that others use too spoils that.
        "wiring_proof": {"enabled": False},
        "gains": {"directory": str(folder / "gains"), "initial": str(shipped("gains/demo_pd.yaml"))},
        "control": {"socket": str(folder / "axis.sock"), "group": own_group()},
        "recorder": {"directory": str(folder / "recordings"), "always": True},
    }
    return merged(base, own)
