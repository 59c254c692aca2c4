"""A whole axis in one process and virtual time: master, cycle and virtual world, stepped from SYNC to SYNC.

The same Master, the same Cycle, the same nodes as over a real bus; only the clock and the wires differ. Used by the
fast demo, by benchmarks, by tests, and wherever a virtual axis is run as fast as it computes.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from servod.common.errors import AnswerIsNo, fault_text
from servod.common.units import NS_PER_S
from servod.formats.config import AxisConfig
from servod.formats.recording.record import RECORD, CycleRecord
from servod.formats.wiring import with_expected
from servod.runtime.fieldbus.master import BringUp, Master
from servod.runtime.loop.axis import AxisState
from servod.runtime.loop.channel import TRAJECTORY_SAMPLES
from servod.runtime.loop.commands import REFUSAL_TEXT, Command, Op, ReferenceKind, Refusal
from servod.runtime.loop.cycle import Cycle
from servod.runtime.loop.plan import LoopPlan
from servod.runtime.loop.wiring.findings import Proof, sentence

if TYPE_CHECKING:
    from servod.drivers.virtual.world import SteppedWorld

#: Virtual time between two looks at an axis that is being enabled.
_ENABLE_STEP_S = 0.02


#: The daemon's supervisor looks at the nodes so often (servod.runtime.daemon.supervisor.TICK_S).
_POLL_NS = 20_000_000


class _ListLink:
    """The cycle's link without a second process: records are packed into one growing buffer."""

    def __init__(self) -> None:
        self.trajectory = array("d", bytes(8 * TRAJECTORY_SAMPLES))
        self.commands: deque[Command] = deque()
        self.raw = bytearray()
        self.proof: Proof | None = None

    def write_record(self, values: Sequence[float]) -> None:
        self.raw += RECORD.pack(*values)

    def write_proof(self, proof: Proof) -> None:
        self.proof = proof

    def next_command(self) -> Command | None:
        return self.commands.popleft() if self.commands else None


def _punctual() -> int:
    """Every wake-up in time."""
    return 0


class SteppedSession:
    """Brings the axis up on construction; `run` advances virtual time; `records` holds every cycle since `clear`.

    `lateness_ns` says for each cycle how late the machine wakes the loop; whoever tries that puts a function there.
    """

    def __init__(self, config: AxisConfig, world: SteppedWorld, law: int, parameters: Sequence[float]) -> None:
        """`law` and `parameters`: the first controller (a packed gain set)."""
        config = with_expected(config)
        self.config, self.world, self.clock = config, world, world.clock
        self.master = Master(config, world.connect(), world.clock, threaded=False)
        self.bring_up: BringUp = self.master.bring_up()
        plan = LoopPlan(config, self.bring_up.amplifier, self.bring_up.encoder, law, tuple(parameters))
        self._link = _ListLink()
        self.loop_bus = world.connect()
        self.cycle = Cycle(plan, self.loop_bus, world.clock, self._link, lambda: True)
        self.lateness_ns: Callable[[], int] = _punctual
        self._deadline_ns = self.clock.now_ns() + self.cycle.period_ns
        self._seq = 0
        self._cycles_until_poll = 0
        self._poll_cycles = max(1, _POLL_NS // self.cycle.period_ns)

    @property
    def raw(self) -> bytes:
        """All records since `clear`, back to back (servod.formats.recording.record.RECORD)."""
        return bytes(self._link.raw)

    @property
    def records(self) -> list[CycleRecord]:
        """All records since `clear`."""
        return [CycleRecord._make(row) for row in RECORD.iter_unpack(self._link.raw)]

    @property
    def latest(self) -> CycleRecord:
        """The last record."""
        return CycleRecord.unpack(bytes(self._link.raw[-RECORD.size :]))

    def clear(self) -> None:
        """Forget the records so far."""
        self._link.raw.clear()

    def run(self, duration_s: float) -> None:
        """Advance virtual time, cycle by cycle."""
        until_ns = self._deadline_ns + round(duration_s * NS_PER_S / self.cycle.period_ns) * self.cycle.period_ns
        while self._deadline_ns < until_ns:
            self._step()
            self._look_after_nodes()

    def _step(self) -> None:
        """One cycle, as servod.runtime.loop.process.run paces it: periods that a late wake-up missed are skipped."""
        cycle, period_ns = self.cycle, self.cycle.period_ns
        late_ns = self.lateness_ns()
        self.clock.sleep_until(self._deadline_ns + late_ns)
        skipped = late_ns // period_ns
        self._deadline_ns += skipped * period_ns
        cycle.step(self._deadline_ns, self._deadline_ns - skipped * period_ns + late_ns, skipped)
        self._deadline_ns += period_ns

    def send(self, op: Op, arguments: Sequence[float] = ()) -> Refusal:
        """Give the loop one command and run until it has answered."""
        self._seq += 1
        self._link.commands.append(Command(self._seq, op, tuple(map(float, arguments))))
        self.run(2 * self.cycle.period_ns / NS_PER_S)
        return Refusal(self.latest.command_result)

    def enable(self, reset_fault: bool = False) -> None:
        """Enable and wait for it; raises AnswerIsNo when the axis does not get there."""
        self._must(self.send(Op.ENABLE, [reset_fault]))
        timeout_s = self.config.amplifier.enable_timeout_s + self.config.wiring_proof.timeout_s
        for _ in range(round(timeout_s / _ENABLE_STEP_S)):
            self.run(_ENABLE_STEP_S)
            if self.cycle.axis.state not in (AxisState.ENABLING, AxisState.PROVING):
                break
        if self.cycle.axis.state != AxisState.ENABLED:
            raise AnswerIsNo(f"the axis is {self.cycle.axis.state.name}, not enabled. {self.why}")

    def move(self, kind: ReferenceKind, arguments: Sequence[float], timeout_s: float = 600.0) -> None:
        """Start a motion and run until it is over; raises AnswerIsNo when it is refused or ends in a fault."""
        self._must(self.send(Op.REFERENCE, [kind, *arguments]))
        for _ in range(round(timeout_s / 0.1)):
            if not self.cycle.reference.active:
                break
            self.run(0.1)
        if self.cycle.axis.state.name != "ENABLED":
            raise AnswerIsNo(f"the motion ended with the axis in {self.cycle.axis.state.name}. {self.why}")

    def close(self) -> None:
        """Leave the bus: for a new session on the same world, as a restarted daemon is one."""
        self.master.close()
        self.loop_bus.close()

    @property
    def why(self) -> str:
        """The latched faults with cause and remedy, for the person who reads the message."""
        text = fault_text(self.latest.faults_latched)
        return f"{sentence(self.proof)} {text}" if self.proof and not self.proof.passed else text

    @property
    def proof(self) -> Proof | None:
        """How the last test of the wiring ended; None before there was one."""
        return self._link.proof

    def load_trajectory(self, positions_rad: Sequence[float]) -> None:
        """Fill the area that ReferenceKind.TABLE reads."""
        self._link.trajectory[: len(positions_rad)] = array("d", positions_rad)

    def _must(self, refusal: Refusal) -> None:
        if refusal != Refusal.DONE:
            raise AnswerIsNo(REFUSAL_TEXT[refusal])

    def _look_after_nodes(self) -> None:
        """The supervisor's part, as often as the daemon's: each event becomes a fault in the loop."""
        self._cycles_until_poll -= 1
        if self._cycles_until_poll > 0:
            return
        self._cycles_until_poll = self._poll_cycles
        self.master.poll()
        for event in self.master.events():
            self._seq += 1
            self._link.commands.append(Command(self._seq, Op.NODE_EVENT, (float(event.fault),)))
