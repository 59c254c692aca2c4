"""A whole axis in one process and virtual time: master, cycle and virtual world, stepped from SYNC to SYNC.

The same Master, the same Cycle, the same nodes as over a real bus; only the clock and the wires differ. Used by the
fast demo, by benchmarks, by tests, and wherever a virtual axis is run as fast as it computes.
"""

from __future__ import annotations

import contextlib
from array import array
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from servod.client.axis import MotionEnded, Watch, check_state, moving
from servod.common.errors import AnswerIsNo
from servod.common.faults import fault_text
from servod.common.units import NS_PER_S
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.store import GainStore, StoredSet
from servod.formats.recording.record import RECORD, CycleRecord
from servod.formats.wiring import with_expected
from servod.kernels.laws import LAWS
from servod.lab.identify.trace import rows_of
from servod.lab.recordings.recording import ROW
from servod.lab.verify.validation import STEP_S, ValidationMotion
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
            if not self.cycle.axis.state.starting:
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


_SLICE_S = 0.1


class SteppedLink:
    """The virtual axis in virtual time."""

    def __init__(self, session: SteppedSession, watch: Watch | None = None) -> None:
        self.session = session
        self._watch = watch or (lambda _seconds: None)

    @property
    def config(self) -> AxisConfig:
        """The session's configuration."""
        return self.session.config

    @property
    def offset_ns(self) -> int | None:
        """Virtual time has no time of day: the same walk gives the same files, byte for byte."""
        return 0

    def enable(self) -> float:
        """Enable with zero gains."""
        self.set_gains(0.0, 0.0)
        self.session.enable()
        return self.session.latest.position_rad

    def set_gains(self, position_nm_per_rad: float, velocity_nms_per_rad: float) -> None:
        """PD feedback of the session's controller."""
        law = LAWS["pd"]
        gains = [position_nm_per_rad, velocity_nms_per_rad, 0.0]
        self._must(self.session.send(Op.ACTIVATE, [0, law.number, len(gains), *gains]))

    def excite(
        self, positions_rad: Sequence[float], torques_nm: Sequence[float], window_rad: float
    ) -> NDArray[np.void]:
        """Run the motion as fast as it computes."""
        session = self.session
        session.load_trajectory([*positions_rad, *torques_nm])
        session.clear()
        extent = [min(positions_rad), max(positions_rad)]
        self._must(session.send(Op.REFERENCE, [ReferenceKind.EXCITE, len(positions_rad), *extent, window_rad]))
        passed_s = 0.0
        while session.cycle.reference.active:
            session.run(_SLICE_S)
            passed_s += _SLICE_S
            self._watch(passed_s)
        rows = moving(rows_of(session.raw))
        try:
            check_state(session.latest)
        except AnswerIsNo as error:
            raise MotionEnded(str(error), rows) from None
        return rows

    def disable(self) -> None:
        """Switch off and let the drive see it."""
        with contextlib.suppress(AnswerIsNo):
            self.session.send(Op.DISABLE)
            self.session.run(self.config.limits.ramp_down_s + 0.1)

    def _must(self, refusal: Refusal) -> None:
        if refusal != Refusal.DONE:
            raise AnswerIsNo(f"the axis refused the experiment: {REFUSAL_TEXT[refusal]}")


# The axis that a set is tried on: a small protocol, and the SYNC-stepped axis behind it.
#
# Under the deployment; `daemon_link` has the same for an axis under a running daemon.


Rows = NDArray[np.void]
#: Told how far a motion is, from 0 to 1.
Tell = Callable[[float], None]

#: After a change of the set, until its offset has faded out.
FADE_S = 1.0
_TRIAL_SLICE_S = 0.25
#: The sines may be short by so many cycles at their ends and still be whole: a record of the first may be late.
_CUT_CYCLES = 50


class DeployLink(Protocol):
    """An axis with a store of gain sets.

    `attempt` and `run` raise AnswerIsNo when the axis drops out: that is an answer to the set that runs. Under a daemon
    what is refused on an axis that stays enabled, and what does not reach it at all, raises Unreachable.
    """

    @property
    def config(self) -> AxisConfig:
        """Limits, period, filter and encoder of the axis."""
        ...

    @property
    def active(self) -> tuple[str, int]:
        """Name and version of the set that runs."""
        ...

    @property
    def enabled(self) -> bool:
        """Whether the axis is enabled."""
        ...

    def enable(self) -> None:
        """Enable under the active set."""
        ...

    def disable(self) -> None:
        """Bring to rest and switch off; never raises."""
        ...

    def stop(self) -> None:
        """Stop at once, whatever runs; never raises."""
        ...

    def run(self, motion: ValidationMotion, window_rad: float, tell: Tell) -> Rows:
        """Run the motion from where the axis stands; all its cycles.

        The sines end when the joint is further than `window_rad` from the reference. Nothing follows them then: a law
        that lost the joint on a sine is given no step.
        """
        ...

    def load(self, gains: GainSet) -> tuple[str, int]:
        """Put a set into the store; its name and version there."""
        ...

    def attempt(self, name: str, version: int) -> None:
        """Change to a stored set on trial: what is stored as active stays so. Back when its offset has faded out."""
        ...

    def keep(self, note: str, figures: dict[str, float]) -> None:
        """Make the set on trial the active one."""
        ...

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        """Change back to the active set; nothing where no set is on trial."""
        ...


class SteppedDeployLink:
    """The virtual axis in virtual time, with a store in a folder; `present` runs when the store has none active."""

    def __init__(self, session: SteppedSession, store: GainStore, present: GainSet) -> None:
        self.session, self._store = session, store
        if store.active() is None:
            stored = store.load(present.to_yaml(), present.name)
            store.activate(stored.name, stored.version)
        self._serial = 0
        self._tried: StoredSet | None = None
        self._change(self._active())

    @property
    def config(self) -> AxisConfig:
        """The session's configuration."""
        return self.session.config

    @property
    def active(self) -> tuple[str, int]:
        """The set on trial, or the store's active one."""
        stored = self._tried or self._active()
        return stored.name, stored.version

    @property
    def enabled(self) -> bool:
        """Whether the axis is enabled."""
        return self.session.cycle.axis.state == AxisState.ENABLED

    def enable(self) -> None:
        """Enable, and let what is held come to rest."""
        self.session.enable()
        self.session.run(FADE_S)

    def disable(self) -> None:
        """Ramp down and let the drive see it."""
        self._off(Op.DISABLE)

    def stop(self) -> None:
        """The drive's quick stop."""
        self._off(Op.QUICK_STOP)

    def run(self, motion: ValidationMotion, window_rad: float, tell: Tell) -> Rows:
        """Run the motion as fast as it computes."""
        self._must_be_enabled()
        session, sines = self.session, motion.sines.tolist()
        session.clear()
        session.load_trajectory([*sines, *[0.0] * len(sines)])
        self._move(ReferenceKind.EXCITE, [len(sines), min(sines), max(sines), window_rad], tell, motion)
        if cut(np.frombuffer(session.raw, dtype=ROW), motion):
            return np.frombuffer(session.raw, dtype=ROW)
        for step_rad in (motion.step_rad, -motion.step_rad):
            self._move(ReferenceKind.STEP, [step_rad, STEP_S], tell, motion)
        return np.frombuffer(session.raw, dtype=ROW)

    def load(self, gains: GainSet) -> tuple[str, int]:
        """Put a set into the store."""
        stored = self._store.load(gains.to_yaml(), gains.name)
        return stored.name, stored.version

    def attempt(self, name: str, version: int) -> None:
        """Change to the set in the loop alone."""
        self._tried = self._store.get(name, version)
        self._change(self._tried)
        self.session.run(FADE_S)
        self._must_be_enabled()

    def keep(self, note: str, figures: dict[str, float]) -> None:
        """Make the set on trial the store's active one."""
        tried = self._tried
        assert tried is not None  # `attempt` came before
        self._store.activate(tried.name, tried.version, note, figures)
        self._tried = None

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        """The store's active set runs again."""
        tried, self._tried = self._tried, None
        if tried is None:
            return
        self._change(self._active())
        self._store.reject(tried.name, tried.version, note, figures)

    def _active(self) -> StoredSet:
        stored = self._store.active()
        assert stored is not None  # from the beginning on
        return stored

    def _change(self, stored: StoredSet) -> None:
        self._serial += 1
        parameters = stored.gains.pack()
        _must(self.session.send(Op.ACTIVATE, [self._serial, stored.gains.law.number, len(parameters), *parameters]))

    def _move(self, kind: ReferenceKind, arguments: Sequence[float], tell: Tell, motion: ValidationMotion) -> None:
        session = self.session
        _must(session.send(Op.REFERENCE, [kind, *arguments]))
        while session.cycle.reference.active:
            session.run(_TRIAL_SLICE_S)
            tell(min(1.0, len(session.raw) // RECORD.size * motion.period_s / motion.duration_s))
        self._must_be_enabled()

    def _must_be_enabled(self) -> None:
        state = self.session.cycle.axis.state
        if state != AxisState.ENABLED:
            raise AnswerIsNo(f"the axis went to {state.name}. {self.session.why}")

    def _off(self, op: Op) -> None:
        with contextlib.suppress(AnswerIsNo):
            self.session.send(op)
            self.session.run(self.config.limits.ramp_down_s + 0.1)


def cut(rows: Rows, motion: ValidationMotion) -> bool:
    """Whether the reference of `rows`, which hold the sines alone, ended before the sines did."""
    ran = rows["cycle"][rows["reference_active"] == 1]
    return len(ran) == 0 or int(ran[-1]) - int(ran[0]) < len(motion.sines) - _CUT_CYCLES


def _must(refusal: Refusal) -> None:
    if refusal != Refusal.DONE:
        raise AnswerIsNo(f"the axis refused: {REFUSAL_TEXT[refusal]}")
