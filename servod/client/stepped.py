"""A whole axis in one process and virtual time: master, cycle and virtual world, stepped from SYNC to SYNC.

The same Master, the same Cycle, the same nodes as over a real bus; only the clock and the wires differ. Used by the
fast demo, by benchmarks, by tests, and wherever a virtual axis is run as fast as it computes.
"""

from __future__ import annotations

import contextlib
import os
from array import array
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from servod.client.axis import LOOK_S, AxisDropped, AxisReading, ReferenceMotion, Watch
from servod.common.clock import Clock
from servod.common.errors import AnswerIsNo
from servod.common.faults import FAULTS, FaultCode, fault_text
from servod.common.units import NS_PER_S
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, pd_set
from servod.formats.model.identified import Devices
from servod.formats.protocol import SampleKey, Verb
from servod.formats.recording.record import RECORD, CycleRecord
from servod.formats.wiring import with_expected
from servod.kernels.motions import Samples
from servod.runtime.daemon.arguments import (
    GainsActivateArgs,
    GainsLoadArgs,
    GainsVerdictArgs,
    TrackArgs,
    check_arguments,
)
from servod.runtime.daemon.gain_bank import GainBank
from servod.runtime.daemon.nodes import Nodes
from servod.runtime.daemon.requests import finish, taken
from servod.runtime.daemon.trajectory import MotionTable
from servod.runtime.fieldbus.master import BringUp, Master, master_ids, start_ids
from servod.runtime.fieldbus.master.planned import narrowed_by_stop, stopping_as_found
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.channel import TRAJECTORY_SAMPLES, Channel
from servod.runtime.loop.commands import REFUSAL_TEXT, Command, Op, Refusal
from servod.runtime.loop.cycle import ANSWERS_AGAIN_CYCLES, Cycle
from servod.runtime.loop.plan import LoopPlan
from servod.runtime.loop.process import supervisor_watch
from servod.runtime.loop.wiring.findings import WiringReport, wiring_sentence

if TYPE_CHECKING:
    from servod.drivers.virtual.world import SteppedWorld, Truth

P = ParamSpec("P")
T = TypeVar("T")

#: Virtual time between two looks at an axis that is being enabled.
_ENABLE_STEP_S = 0.02
_STAYS_POWERED = FAULTS[FaultCode.DRIVE_STAYS_POWERED].bit


#: The daemon's supervisor looks at the nodes so often (servod.runtime.daemon.supervisor.TICK_S).
_POLL_NS = 20_000_000


class ListPort:
    """The cycle's port without a second process: records are packed into one growing buffer."""

    def __init__(self, clock: Clock) -> None:
        """`clock` stamps the commands."""
        self.trajectory: Samples = array("d", bytes(8 * TRAJECTORY_SAMPLES))
        self.proof: WiringReport | None = None
        self.orphaned = False
        self._clock, self._rows = clock, bytearray()
        self._commands: deque[Command] = deque()
        self._seq = 0

    @property
    def rows(self) -> bytearray:
        """All records since it was cleared, back to back (servod.formats.recording.record.RECORD)."""
        return self._rows

    def write_record(self, values: Sequence[float]) -> None:
        """As LoopPort."""
        self._rows += RECORD.pack(*values)

    def write_proof(self, proof: WiringReport) -> None:
        """As LoopPort."""
        self.proof = proof

    def next_command(self) -> Command | None:
        """As LoopPort."""
        return self._commands.popleft() if self._commands else None

    def supervisor_alive(self) -> bool:
        """It is the caller, until it dies."""
        return not self.orphaned

    def send(self, op: Op, arguments: Sequence[float]) -> None:
        """Give the loop a command."""
        self._seq += 1
        self._commands.append(Command(self._seq, op, tuple(map(float, arguments)), self._clock.now_ns()))

    def load_trajectory(self, samples: Sequence[float]) -> None:
        """Fill the area that ReferenceKind.TABLE reads."""
        assert isinstance(self.trajectory, array)
        self.trajectory[: len(samples)] = array("d", samples)

    def look(self) -> None:
        """The supervisor's round."""


class ChannelPort(ListPort):
    """The daemon's shared memory between cycle and session, both sides in one process, and the supervisor's part."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.supervisor = Channel(clock=clock)
        self.loop = Channel(os.dup(self.supervisor.fd), clock)
        self.trajectory = self.loop.trajectory
        self._alive = supervisor_watch(self.loop, clock, os.getppid())

    @property
    def rows(self) -> bytearray:
        """All records since it was cleared, as they came."""
        for row in self.supervisor.drain():
            self._rows += row
        return self._rows

    def write_record(self, values: Sequence[float]) -> None:
        """As LoopPort."""
        self.loop.write_record(values)

    def write_proof(self, proof: WiringReport) -> None:
        """As LoopPort."""
        self.loop.write_proof(proof)

    def next_command(self) -> Command | None:
        """As LoopPort."""
        return self.loop.next_command()

    def supervisor_alive(self) -> bool:
        """As the loop process sees it."""
        return not self.orphaned and self._alive()

    def send(self, op: Op, arguments: Sequence[float]) -> None:
        """Queue a command."""
        self.supervisor.send(op, tuple(map(float, arguments)))

    def load_trajectory(self, samples: Sequence[float]) -> None:
        """Fill the area that ReferenceKind.TABLE reads."""
        self.supervisor.write_trajectory(samples)

    def look(self) -> None:
        """Beat, read what came, and tell the loop of what came bent."""
        self.supervisor.beat()
        _, self.proof = len(self.rows), self.supervisor.proofs()[1]
        if self.supervisor.take_corrupt():
            self.send(Op.NODE_EVENT, (FaultCode.CHANNEL_CORRUPT,))


def _punctual() -> int:
    """Every wake-up in time."""
    return 0


class SteppedSession:
    """Brings the axis up on construction; `run` advances virtual time; `records` holds every cycle since `clear`.

    `lateness_ns` says for each cycle how late the machine wakes the loop; whoever tries that puts a function there.
    """

    def __init__(
        self,
        config: AxisConfig,
        world: SteppedWorld,
        law: int,
        parameters: Sequence[float],
        port: ListPort | None = None,
    ) -> None:
        """`law` and `parameters`: the first controller (a packed gain set)."""
        config, self.world, self.clock = with_expected(config), world, world.clock
        narrowed, _ = narrowed_by_stop(config)
        buses = [world.connect(ids(config)) for ids in (master_ids, start_ids)]
        self.master = Master(narrowed, buses[0], world.clock, threaded=False, start_bus=buses[1])
        self.bring_up: BringUp = self.master.bring_up()
        config, self.stopping = stopping_as_found(config, self.bring_up.amplifier)
        self.config = config
        stop = None if self.stopping is None else self.stopping.facts
        plan = LoopPlan(config, self.bring_up.amplifier, self.bring_up.encoder, law, tuple(parameters), stop=stop)
        self.port = port or ListPort(world.clock)
        self.loop_bus = world.connect()
        self.cycle = Cycle(plan, self.loop_bus, world.clock, self.port, self.port.supervisor_alive)
        self.master.hand_over()
        self.lateness_ns: Callable[[], int] = _punctual
        self._deadline_ns = self.clock.now_ns() + self.cycle.period_ns
        self._cycles_until_poll = 0
        self.loop_dead = self._stays_powered = self._switched_off = False
        self._stops_in = 0
        self._poll_cycles = max(1, _POLL_NS // self.cycle.period_ns)

    @property
    def raw(self) -> bytes:
        """All records since `clear`, back to back (servod.formats.recording.record.RECORD)."""
        return bytes(self.port.rows)

    @property
    def records(self) -> list[CycleRecord]:
        """All records since `clear`."""
        return [CycleRecord._make(row) for row in RECORD.iter_unpack(self.port.rows)]

    @property
    def latest(self) -> CycleRecord:
        """The last record."""
        return CycleRecord.unpack(bytes(self.port.rows[-RECORD.size :]))

    def clear(self) -> None:
        """Forget the records so far."""
        self.port.rows.clear()

    def run(self, duration_s: float) -> None:
        """Advance virtual time, cycle by cycle."""
        until_ns = self._deadline_ns + round(duration_s * NS_PER_S / self.cycle.period_ns) * self.cycle.period_ns
        while self._deadline_ns < until_ns:
            self._step()
            self._look_after_nodes()

    def die(self, loop: bool, supervisor: bool) -> None:
        """What `kill -9` does: a dead loop takes part in nothing any more, a dead supervisor leaves the loop alone."""
        self.loop_dead |= loop
        self.port.orphaned |= supervisor

    def _step(self) -> None:
        """One cycle, as servod.runtime.loop.process.run paces it: periods that a late wake-up missed are skipped."""
        cycle, period_ns = self.cycle, self.cycle.period_ns
        if self.loop_dead or (self.port.orphaned and cycle.finished):
            self.clock.sleep_until(self._deadline_ns)
            self._deadline_ns += period_ns
            return
        late_ns = self.lateness_ns()
        self.clock.sleep_until(self._deadline_ns + late_ns)
        skipped = late_ns // period_ns
        self._deadline_ns += skipped * period_ns
        cycle.step(self._deadline_ns, self._deadline_ns - skipped * period_ns + late_ns, skipped)
        self._deadline_ns += period_ns

    def send(self, op: Op, arguments: Sequence[float] = ()) -> Refusal:
        """Give the loop one command and run until it has answered."""
        result = self._give(op, arguments)
        return Refusal(result if result >= 0 else self._give(Op.CONFIRM, (result,)))

    def _give(self, op: Op, arguments: Sequence[float]) -> int:
        self.port.send(op, arguments)
        self.run(2 * self.cycle.period_ns / NS_PER_S)
        return self.latest.command_result

    def enable(self, reset_fault: bool = False) -> None:
        """Enable and wait for it; raises AnswerIsNo when the axis does not get there."""
        self._must(self.send(Op.ENABLE, [reset_fault]))
        amplifier = self.config.amplifier
        timeout_s = amplifier.enable_timeout_s + amplifier.brake.release_s + self.config.wiring_proof.timeout_s
        for _ in range(round(timeout_s / _ENABLE_STEP_S)):
            self.run(_ENABLE_STEP_S)
            if not self.cycle.axis.state.arriving:
                break
        if self.cycle.axis.state != AxisState.ENABLED:
            raise AnswerIsNo(f"the axis is {self.cycle.axis.state.name}, not enabled. {self.why}")

    def close(self) -> None:
        """Leave the bus: for a new session on the same world, as a restarted daemon is one."""
        self.master.close()
        self.loop_bus.close()

    @property
    def why(self) -> str:
        """The latched faults with cause and remedy, for the person who reads the message."""
        text = fault_text(self.latest.faults_latched)
        return f"{wiring_sentence(self.proof)} {text}" if self.proof and not self.proof.passed else text

    @property
    def proof(self) -> WiringReport | None:
        """How the last test of the wiring ended; None before there was one."""
        return self.port.proof

    def load_trajectory(self, positions_rad: Sequence[float]) -> None:
        """Fill the area that ReferenceKind.TABLE reads."""
        self.port.load_trajectory(positions_rad)

    def _must(self, refusal: Refusal) -> None:
        if refusal != Refusal.DONE:
            raise AnswerIsNo(REFUSAL_TEXT[refusal])

    def _look_after_nodes(self) -> None:
        """The supervisor's part, as often as the daemon's: each event becomes a fault in the loop."""
        self._stays_powered |= bool(self.cycle.axis.faults & _STAYS_POWERED)
        self._stops_in -= 1
        if self._stops_in == 0 and not (self.port.orphaned or self.loop_dead):
            self._stop_withdrawn()
        self._cycles_until_poll -= 1
        if self._cycles_until_poll > 0:
            return
        self._cycles_until_poll = self._poll_cycles
        if self.port.orphaned:
            return
        if self.loop_dead:
            self._end_without_loop()
            return
        self.port.look()
        self.master.poll()
        for event in self.master.events():
            self.port.send(Op.NODE_EVENT, (float(event.fault),))
        if self._stays_powered and not self._switched_off:
            self._switched_off, self._stops_in = True, ANSWERS_AGAIN_CYCLES

    def _stop_withdrawn(self) -> None:
        """What the daemon does beside its rounds for a drive that stays powered, once that may answer SDO again. The
        loop, which has withdrawn, is not late for it: its next cycle comes when this is done."""
        Nodes(self.master, self.bring_up).stop_axis()
        behind_ns = max(0, self.clock.now_ns() - self._deadline_ns)
        periods = -(-behind_ns // self.cycle.period_ns)
        self._deadline_ns += periods * self.cycle.period_ns
        self.cycle.stand_still(periods)

    def _end_without_loop(self) -> None:
        """What the daemon does when it sees its loop dead, before it ends."""
        self.port.orphaned = True
        Nodes(self.master, self.bring_up).stop_axis()


class SteppedAxis:
    """servod.client.axis.AxisClient in virtual time, around the gain bank of the daemon.

    The sets are in the store `folder`/gains. The session was brought up with `initial`, or else without torque; where
    the store has an active set already, `run_active` gives it to the loop.
    """

    #: Virtual time has no time of day: the same walk gives the same files, byte for byte.
    offset_ns: int | None = 0

    def __init__(self, session: SteppedSession, folder: Path, initial: GainSet | None = None) -> None:
        """Raises BadInput when the folder cannot be used."""
        self.session, self._slow = session, _InPlace()
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / "initial.yaml"
        file.write_text((initial or powerless()).to_yaml(), encoding="utf-8")
        gains = session.config.gains.model_copy(update={"directory": folder / "gains", "initial": file})
        # Nobody can be hurt: any set may run here, as with gains.accept_uncertified, also one of another loop.
        self._bank = GainBank(session.config.model_copy(update={"gains": gains}), lambda _gains, _config: None)
        file.unlink()  # it is in the store now

    @property
    def config(self) -> AxisConfig:
        """The session's configuration."""
        return self.session.config

    @property
    def devices(self) -> Devices:
        """None: whatever the configuration states, nobody touched it."""
        return Devices()

    @property
    def active(self) -> tuple[str, int]:
        """The set that the loop was given last."""
        return self._bank.newest.name, self._bank.newest.version

    def run_active(self) -> None:
        """Give the loop the store's active set, as the one that it began with."""
        gains, parameters = self._bank.newest.gains, self._bank.newest.gains.pack()
        finish(self._send(Op.ACTIVATE, (0, gains.law.number, len(parameters), *parameters)))

    def status(self) -> AxisReading:
        """As of the last cycle."""
        cycle = self.session.cycle
        moves, reference_rad = cycle.reference.active, cycle.reference.position_rad
        return AxisReading(cycle.axis.state.name, bool(moves), cycle.encoder_position_rad, reference_rad)

    def truth(self) -> Truth:
        """The joint itself, which no encoder shows."""
        return self.session.world.truth()

    def enable(self, reset_fault: bool = False) -> None:
        """Enable, and wait for it."""
        self.session.enable(reset_fault)

    def disable(self) -> None:
        """Ramp down and let the drive see it."""
        self._off(Op.DISABLE)

    def stop(self) -> None:
        """The drive's quick stop."""
        self._off(Op.QUICK_STOP)

    def load(self, gains: GainSet) -> tuple[str, int]:
        """Put a set into the store."""
        stored = finish(self._bank.load(GainsLoadArgs(name=gains.name, text=gains.to_yaml()), self._slow))
        return stored["name"], stored["version"]

    def activate(self, name: str, version: int) -> None:
        """Change to the set in the loop alone."""
        args = GainsActivateArgs(name=name, version=version, trial=True)
        finish(self._bank.activate(args, self._send, self._slow))

    def keep(self, note: str, figures: dict[str, float]) -> None:
        """Make the set on trial the store's active one."""
        finish(self._bank.keep(GainsVerdictArgs(note=note, figures=figures), self._send, self._slow))

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        """The store's active set runs again."""
        args = GainsVerdictArgs(note=note, figures=figures, trial=True)
        finish(self._bank.rollback(args, self._send, self._slow))

    def begin(self, motion: ReferenceMotion) -> None:
        """Give the loop the command that the daemon would; the loop alone judges it."""
        words = dict(motion.arguments)
        positions_rad, torques_nm = words.pop(SampleKey.POSITIONS, None), words.pop(SampleKey.TORQUES, None)
        args: TrackArgs = check_arguments(Verb.TRACK, words | {"uploaded": True})
        table = args.table(MotionTable(positions_rad, torques_nm))
        self.session.load_trajectory(table.area())
        refusal = self.session.send(Op.REFERENCE, args.reference(table))
        if refusal != Refusal.DONE:
            self._require_enabled()
            raise AnswerIsNo(REFUSAL_TEXT[refusal])

    def run(
        self,
        motion: ReferenceMotion,
        watch: Watch | None = None,
        look_s: float = LOOK_S,
        each_cycle: Watch | None = None,
    ) -> bytes:
        """Run the motion as fast as it computes; `each_cycle` is told of every cycle."""
        self.session.clear()
        self.begin(motion)
        passed_s = 0.0
        while self.session.cycle.reference.active:
            self._pass(passed_s, look_s, each_cycle)
            passed_s += look_s
            if watch:
                watch(passed_s)
        raw = self.session.raw
        self._require_enabled(raw)
        return raw

    def wait(self, duration_s: float) -> None:
        """Advance virtual time."""
        self.session.run(duration_s)
        self._require_enabled()

    def _pass(self, passed_s: float, duration_s: float, each_cycle: Watch | None) -> None:
        if each_cycle is None:
            self.session.run(duration_s)
            return
        period_s = self.session.cycle.period_ns / NS_PER_S
        for count in range(1, round(duration_s / period_s) + 1):
            self.session.run(period_s)
            each_cycle(passed_s + count * period_s)

    async def _send(self, op: Op, arguments: Sequence[float]) -> CycleRecord:
        """The bank's way to the loop, which has answered when this is back."""
        self.session.send(op, arguments)
        return taken(self.session.latest)

    def _require_enabled(self, raw: bytes = b"") -> None:
        state = self.session.cycle.axis.state
        if state != AxisState.ENABLED:
            raise AxisDropped(state.name, self.session.why, raw)

    def _off(self, op: Op) -> None:
        with contextlib.suppress(AnswerIsNo):
            self.session.send(op)
            self.session.run(self.config.limits.ramp_down_s + self.config.amplifier.brake.engage_s + 0.1)


class _InPlace(Executor):
    """The bank's work on disk, done in the caller's thread."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Do it now."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def powerless() -> GainSet:
    """A PD controller with zero gains: what an axis without any tuning runs."""
    return pd_set("powerless", 0.0, 0.0)
