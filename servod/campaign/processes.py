"""The axis under test as processes: daemon, loop and virtual axis on the wall clock, on a wire of their own.

The same axis runs on the hub's socket and on SocketCAN. The drive's record judges, whoever was killed; the user's side
is what `status` says, and the daemon's log, which is left when nobody answers.
"""

from __future__ import annotations

import contextlib
import re
import signal
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from typing import Any

import yaml

from servod.axis import AxisState
from servod.axis_model import axis_model_yaml
from servod.campaign.inputs import Nested, config_of, merged, plant_of, shipped_config
from servod.campaign.machine import Machine, Process, wait_for_state
from servod.campaign.recorded import lost_records, wait_for_rows
from servod.campaign.scenario import Recovery, Runs, Scenario, Start
from servod.campaign.under_test import AMPLIFIER, MOTION, Observation
from servod.campaign.wire import HubWire, Wire
from servod.cia import SDO_REQUEST_BASE
from servod.commands import Op
from servod.control import ControlClient, Verb
from servod.demo.axis import last_core, own_group
from servod.drivers.virtual.amplifier import AMPLIFIER_EDS
from servod.drivers.virtual.bus_faults import FRAME_KINDS, MYSELF, BusFault
from servod.drivers.virtual.client import VirtualBus
from servod.drivers.virtual.dictionary import Dictionary
from servod.drivers.virtual.drive_record import DriveSample
from servod.drivers.virtual.encoder import ENCODER_EDS
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.errors import BadInput, FaultCode, ServodError, Unreachable
from servod.hal import DriveState
from servod.shipped import shipped
from servod.units import NS_PER_US
from servod.yaml12 import validate

_SINE = {"kind": "sine", **MOTION[Runs.PROCESSES]._asdict(), "duration_s": 600.0}
#: The joint moves when its torque is so large [N*m]: enough to lose.
_MOVING_NM, _START_S = 0.01, 20.0
#: The judge continues the motion of before the injection: so many periods it must have seen of it, the first third of
#: which it leaves out.
_SHOWN_PERIODS = 1.5
#: A participant that leaves takes with it what still waits in its queue.
_SENT_S = 0.01
_VERBS = {Op.DISABLE: Verb.DISABLE, Op.QUICK_STOP: Verb.STOP, Op.HALT: Verb.HALT}
_TOLD = re.compile(r"fault ([A-Z_]+) \(")
_ASKS_TO_END = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_DOWNLOAD = struct.Struct("<BHB4s")
_FAULTED = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)


class ProcessAxis:
    """servod.campaign.under_test.AxisUnderTest on the wall clock.

    `folder` takes everything that is written; `over` is laid over the configuration before the scenario's own keys;
    `machine` has the processes, where they are not to be made here on the hub's socket.
    """

    def __init__(
        self, scenario: Scenario, folder: Path, machine: Machine | None = None, over: Nested | None = None
    ) -> None:
        """Raises BadInput for a scenario's keys."""
        self.folder, self.machine = folder, machine or Machine(folder, HubWire(folder))
        self.wire = self.machine.wire
        self.config = config_of(scenario, merged(_base(folder, self.wire), over or {}))
        settings = validate(scenario.settings, VirtualAxisSettings, f"{scenario.title}: settings")
        (folder / "settings.yaml").write_text(yaml.safe_dump(settings.model_dump(mode="json")))
        (folder / "plant.yaml").write_text(axis_model_yaml(plant_of(scenario)))
        self.machine.config.write_text(yaml.safe_dump(self.config.model_dump(mode="json")))
        self._client: ControlClient | None = None
        self._hit_ns: int | None = None
        self._asked_to_end = self._off = self._up = False
        self.refusal = ""
        self.stopped_client: Popen[bytes] | None = None

    def now_ns(self) -> int:
        """The clock of the drive's record."""
        return time.monotonic_ns()

    def start(self, start: Start) -> None:
        """Start the processes, enable and move, as far as `start` says."""
        self.machine.start_virtual_axis()
        self._off = start is Start.OFF
        if self._off:
            return
        self.machine.start_daemon()
        self._up = True
        if start in (Start.ENABLED, Start.MOVING):
            self.client.call(Verb.ENABLE)
            wait_for_state(self.client, AxisState.ENABLED.name)
        if start is Start.MOVING:
            self.client.call(Verb.TRACK, **_SINE)
            self._wait_until(self._moves, "the axis does not move")
            time.sleep(_SHOWN_PERIODS / MOTION[Runs.PROCESSES].frequency_hz)
        self._wait_until(self._recorded, "the recorder writes nothing")

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
        """Ask the hub, as somebody else than the loop: what shall hit the loop's own connection is not to be had."""
        foreign = self.wire.foreign()
        with contextlib.closing(foreign):
            of_the_loop = fault.participant == MYSELF and fault.kind not in FRAME_KINDS
            if of_the_loop or not isinstance(foreign, VirtualBus):
                raise BadInput("bus fault", fault.kind.name, "one that another participant of the hub can ask for")
            foreign.inject(fault)

    def frame(self, can_id: int, data: bytes) -> None:
        """Send as somebody else on the bus."""
        with contextlib.closing(self.wire.foreign()) as foreign:
            foreign.send(can_id, data)
            time.sleep(_SENT_S)

    def sdo_write(self, node_id: int, index: int, subindex: int, value: int) -> None:
        """One expedited download, as a service tool on the same bus."""
        entry = Dictionary(AMPLIFIER_EDS if node_id == AMPLIFIER else ENCODER_EDS).entry(index, subindex)
        entry.value = value
        data = entry.encode()
        head = 0x23 | (4 - len(data)) << 2  # expedited, with its length (CiA 301, 7.2.4.3.3)
        self.frame(SDO_REQUEST_BASE + node_id, _DOWNLOAD.pack(head, index, subindex, data))

    def command(self, op: Op, arguments: Sequence[float] = ()) -> None:
        """Ask the daemon for it."""
        self.call(_VERBS[op], **({"on": bool(arguments[0])} if op is Op.HALT else {}))

    def call(self, verb: Verb, **args: Any) -> dict[str, Any]:
        """Ask the daemon for anything; a refusal is kept, and gives nothing."""
        try:
            return self.client.call(verb, **args)
        except ServodError as error:
            self.refusal = str(error)
            return {}

    def signal(self, who: Sequence[Process], number: signal.Signals) -> None:
        """Send a signal; from the first that kills on, records may be missing."""
        if number is not signal.SIGCONT and set(who) & {Process.DAEMON, Process.LOOP}:
            self._hit_ns = self._hit_ns or self.now_ns()
        self._asked_to_end |= Process.DAEMON in who and number in _ASKS_TO_END
        self.machine.send(who, number)

    def restart_daemon(self) -> None:
        """As the service manager does it: SIGTERM, wait, start."""
        self.signal([Process.DAEMON], signal.SIGTERM)
        self._expect_end()
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
            self._expect_end()
        samples = self.machine.drive_samples()
        axis, shown, overrun = self._shown(samples)
        told = {FaultCode[name] for name in _TOLD.findall(self.machine.daemon_log())}
        lost = self._lost_records() + overrun if self._up and self.config.recorder.always else None
        return Observation(samples, axis, frozenset(shown | told), self.refusal, lost)

    def recover(self, recovery: Recovery) -> bool:
        """Do what a person would do, and hold for a tenth of a second."""
        try:
            if recovery is Recovery.RESTART:
                self._restart_what_ended()
            if recovery is not Recovery.NONE:
                self.client.call(Verb.ENABLE, reset_fault=recovery is Recovery.RESET_FAULT)
            time.sleep(0.1)
            return bool(self.client.call(Verb.STATUS)["axis"]["state"] == AxisState.ENABLED.name)
        except ServodError as error:
            self.refusal = str(error)
            return False

    def close(self) -> None:
        """End all processes."""
        self.leave()
        self.machine.close()

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

    def _expect_end(self) -> None:
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
