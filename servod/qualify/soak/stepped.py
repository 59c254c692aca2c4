"""A soak in virtual time: the stepped axis of the campaign, driven through the schedule and checked batch by batch.

Everything that is recorded passes here once: the loop's rows, the SYNC frames of an independent listener, the samples
of the drive's own record; and every so often the recorder's file, read back.
"""

from __future__ import annotations

import os
import random
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from servod.common.errors import AnswerIsNo
from servod.common.faults import FAULTS, FaultCode, fault_text, faults_in
from servod.common.shipped import shipped
from servod.common.units import NS_PER_S
from servod.drivers.virtual.drive_record import DriveTail
from servod.formats.gains.gain_set import load_gains
from servod.kernels.laws import LAWS
from servod.lab.recordings.recording import Rows, rows_of
from servod.qualify.faults.actions import action_of
from servod.qualify.faults.scenario import Injection, Recovery, Runs, ScenarioStart
from servod.qualify.faults.stepped import RECORD_NAME, SteppedUnderTest
from servod.qualify.soak.drive import (
    DriveCheck,
    Samples,
    check_reaction,
    check_trace,
    detected_after_ms,
    reaction_in,
    samples_of,
)
from servod.qualify.soak.kinds import ALWAYS, InjectionKind, fault_bits
from servod.qualify.soak.plan import Episode, Move, SoakEnding, home, nothing_yet
from servod.qualify.soak.rows import ANSWER_CYCLES, RecordingCheck, RowCheck
from servod.qualify.soak.syncs import SyncCheck, SyncListener
from servod.qualify.soak.tally import Counts, FaultTally, Findings, Tally, Wrong
from servod.qualify.soak.traces import LISTEN_S, Listener, trace_of
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import REFUSAL_TEXT, Op, Refusal

#: Gain sets that the schedule changes between; every restart begins with the first.
GAIN_SETS = ("demo_pd", "demo_pd_dob", "demo_pd_lugre", "demo_local")
#: Farther than this from zero [rad] the axis is brought home before the next motion.
_FAR_RAD = 0.6
#: Every so many episodes the rows go through the recorder as well.
_RECORDED_EVERY = 10
#: Time after a repair before a person tries again, and for a stop to end [s].
_PATIENCE_S, _STOPPING_S = 0.1, 0.6
_TRIES = 5
_NOT_PROVEN = FAULTS[FaultCode.WIRING_NOT_PROVEN].bit


class Batch(NamedTuple):
    """What was recorded since the last one."""

    rows: Rows
    samples: Samples


class SteppedSoak:
    """One axis for the whole soak. `folder` takes the drive's record and the recordings."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.findings, self.tally = Findings(), Tally()
        self._axis = SteppedUnderTest(nothing_yet(seed, proves=True), folder)
        self._heard, self._drive = SyncListener(self._axis.world.hub), DriveTail(folder / RECORD_NAME)
        self._axis.start(ScenarioStart.ENABLED)
        config = self._axis.session.config
        self._period_ns = self._axis.session.cycle.period_ns
        self._rows = RowCheck(self._period_ns, config.limits.torque_nm, self.findings)
        self._syncs = SyncCheck(self._period_ns, self.findings)
        self._samples = DriveCheck(_drive_limit_nm(self._axis), self.findings)
        self._recorder = RecordingCheck(config, folder / "recordings", self.findings)
        self._sets = {name: load_gains(shipped(f"gains/{name}.yaml")) for name in GAIN_SETS}
        self._serial = 1
        self.findings.begin(self._axis.now_ns())
        self._settle()

    @property
    def counts(self) -> Counts:
        """What was counted so far."""
        rows, syncs, recorder = self._rows, self._syncs, self._recorder
        return Counts(
            self._period_ns,
            rows.cycles,
            rows.rows,
            rows.missed,
            syncs.syncs,
            syncs.taken,
            self._samples.samples,
            recorder.recordings,
            recorder.rows,
        )

    def processes(self) -> dict[str, int]:
        """Everything runs in this one."""
        return {"soak": os.getpid()}

    def episode(self, episode: Episode) -> None:
        """Let one episode happen. Raises AnswerIsNo when the axis cannot be enabled any more, by nothing."""
        self.findings.episode = episode.number
        self.tally.episodes += 1
        if episode.number % _RECORDED_EVERY == 1:
            self._recorder.start()
        self._go_home()
        self._change_law(episode.law)
        if episode.proves:
            self._begin_proof()
        if episode.proves or self._move(episode.move):
            self._run(episode.before_s)
        self._settle()
        if episode.fault is not None:
            self._befall(episode.fault, random.Random(episode.seed))  # noqa: S311
        if self._axis.session.cycle.reference.active:
            self._end(episode)
        self._recorder.stop(self._axis.now_ns())

    def finish(self) -> None:
        """Everything was checked batch by batch; a batch that was interrupted is not judged."""

    def close(self) -> None:
        """Leave the bus and the files."""
        self._axis.session.close()
        self._drive.close()
        self._recorder.close()

    # --- what happens ------------------------------------------------------------------------------------------

    def _run(self, duration_s: float) -> None:
        self._axis.session.run(duration_s)

    def _go_home(self) -> None:
        position_rad = self._axis.session.cycle.reference.position_rad
        if abs(position_rad) > _FAR_RAD and self._move(home(position_rad)):
            self._finish(home(position_rad))

    def _change_law(self, name: str | None) -> None:
        if name is None:
            return
        gains, self._serial = self._sets[name], self._serial + 1
        packed = gains.pack()
        if self._send(Op.ACTIVATE, [self._serial, LAWS[gains.law.name].number, len(packed), *packed]):
            self.tally.laws[name] += 1

    def _move(self, move: Move) -> bool:
        if move.table:
            self._axis.session.load_trajectory(move.table)
        self.tally.moves[move.kind.name] += 1
        return self._send(Op.REFERENCE, (move.kind, *move.arguments))

    def _send(self, op: Op, arguments: Sequence[float] = ()) -> bool:
        refusal = self._axis.session.send(op, arguments)
        if refusal != Refusal.DONE:
            text = f"{op.name} {arguments[:1]}: {REFUSAL_TEXT[refusal]}"
            self.findings.add(Wrong.REFUSED, self._axis.now_ns(), text)
        return refusal == Refusal.DONE

    def _begin_proof(self) -> None:
        """Switch off and on, up to where the wiring is tested again."""
        self._switch_off(Op.DISABLE)
        self._send(Op.ENABLE, [0.0, 1.0])
        self._wait_out(AxisState.ENABLING)

    def _switch_off(self, op: Op) -> None:
        self._send(op)
        self._run(_STOPPING_S)
        self._expect(AxisState.DISABLED)
        self._settle()

    def _wait_out(self, state: AxisState) -> None:
        """Run until the axis leaves `state`, or the longest proof would be over."""
        left_s = self._axis.session.config.wiring_proof.timeout_s
        while self._axis.session.cycle.axis.state is state and left_s > 0.0:
            self._run(0.01)
            left_s -= 0.01

    def _end(self, episode: Episode) -> None:
        self.tally.endings[episode.ending.name] += 1
        if episode.ending in (SoakEnding.DISABLE, SoakEnding.QUICK_STOP):
            self._switch_off(Op.DISABLE if episode.ending is SoakEnding.DISABLE else Op.QUICK_STOP)
            self._recover(Recovery.ENABLE, 0)
            return
        if episode.ending is SoakEnding.HALT:
            self._send(Op.HALT, [1.0])
            self._run(0.2)
            self._send(Op.HALT, [0.0])
        self._finish(episode.move)
        self._settle()

    def _finish(self, move: Move) -> None:
        """Run until the motion is over."""
        reference, left_s = self._axis.session.cycle.reference, move.duration_s + 1.0
        while reference.active and left_s > 0.0:
            self._run(0.1)
            left_s -= 0.1
        self._expect(AxisState.ENABLED)

    def _expect(self, state: AxisState) -> bool:
        axis = self._axis.session.cycle.axis
        if axis.state is not state:
            self.findings.add(Wrong.STATE, self._axis.now_ns(), f"axis {axis.state.name} instead of {state.name}")
        return axis.state is state

    # --- faults ------------------------------------------------------------------------------------------------

    def _befall(self, kind: InjectionKind, chance: random.Random) -> None:
        """Inject, watch, judge, repair, recover."""
        tally, injection = self.tally.of(kind.name), kind.injection(chance)
        listener = None if kind.expects else self._listen(injection)
        proving = self._axis.session.cycle.axis.state is AxisState.PROVING
        kind = kind.while_proving() if proving else kind
        tally.injected += 1
        tally.due += bool(kind.expects)
        tally.proving += proving
        injected_ns = self._axis.now_ns()
        self._act(injection)
        self._run(kind.watch_ms / 1e3)
        batch = self._settle(kind.explained, kind.takes_syncs, kind.deaf_cycles)
        happened = listener is not None and listener.leave()
        self._judge(kind, batch, injected_ns, happened)
        repair = kind.repair()
        if repair is not None:
            self._act(repair)
            self._run(_PATIENCE_S)
        if kind.recovery is Recovery.NONE:
            tally.recovered += self._ride_on(kind, tally, happened)
        else:
            tally.recovered += self._recover(kind.recovery, kind.explained)

    def _listen(self, injection: Injection) -> Listener | None:
        """Listen for what will show that it happened, from some time before; None where nothing would."""
        trace = trace_of(action_of(injection, "soak", Runs.STEPPED))
        if trace is None:
            return None
        listener = Listener(self._axis.world.hub, trace)
        self._run(LISTEN_S)
        return listener

    def _ride_on(self, kind: InjectionKind, tally: FaultTally, happened: bool) -> bool:
        """See the axis go on as it was; what it rides through may spoil a proof, which is then done again."""
        self._wait_out(AxisState.PROVING)
        if self._axis.session.cycle.axis.latched & kind.explained & _NOT_PROVEN:
            tally.spoilt += happened
            return self._recover(Recovery.RESET_FAULT, kind.explained)
        self._settle(kind.explained)
        goes_on = self._expect(AxisState.ENABLED)
        tally.ridden += goes_on and happened
        return goes_on

    def _act(self, injection: Injection) -> None:
        action_of(injection, "soak", Runs.STEPPED).apply(self._axis)

    def _judge(self, kind: InjectionKind, batch: Batch, injected_ns: int, happened: bool) -> None:
        """Was it found in the log in time, and was the torque gone in time by the drive's own record?

        Of what is ridden through no fault word tells; there must be its trace.
        """
        tally, latched = self.tally.of(kind.name), self._axis.session.cycle.axis.latched
        tally.latched.update(f.code.name for f in faults_in(latched & ~fault_bits(ALWAYS)))
        if not kind.expects:
            check_trace(kind, happened, injected_ns, self.findings)
            return
        detected_ms = detected_after_ms(batch.rows, injected_ns, fault_bits(kind.expects))
        if detected_ms is None:
            names = ", ".join(f.code.name for f in faults_in(latched)) or "nothing"
            self.findings.add(Wrong.NOT_FOUND, injected_ns, f"{kind.name}: latched is {names}")
            return
        tally.found += 1
        tally.detected.add(detected_ms)
        if detected_ms > kind.latched_ms:
            text = f"{kind.name}: latched after {detected_ms:.0f} ms, {kind.latched_ms:g} ms allowed"
            self.findings.add(Wrong.LATE, injected_ns, text)
        check_reaction(kind, reaction_in(batch.samples, injected_ns), injected_ns, tally, self.findings)

    def _recover(self, recovery: Recovery, explained: int) -> bool:
        """What a person does; and what he tries when that does not help."""
        if self._try(recovery, explained):
            return True
        why = fault_text(self._axis.session.cycle.axis.latched)
        self.findings.add(Wrong.NOT_RECOVERED, self._axis.now_ns(), f"by {recovery}: {self._axis.refusal} {why}")
        for _ in range(_TRIES):
            self._switch_off_and_on()
            if self._try(Recovery.RESTART, -1):
                return False
        raise AnswerIsNo(f"episode {self.findings.episode}: the axis cannot be enabled any more. {why}")

    def _switch_off_and_on(self) -> None:
        """Both nodes lose their supply; the loop that knew them is not asked again."""
        world = self._axis.world
        for _ in range(2):
            world.clock.sleep_until(world.clock.now_ns() + round(_STOPPING_S * NS_PER_S))
            world.devices.power_on(world.clock.now_ns())

    def _try(self, recovery: Recovery, explained: int) -> bool:
        self._settle(explained)
        if recovery is Recovery.RESTART:
            self.tally.restarts += 1
            self._rows.new_session()
        done = self._axis.recover(recovery)
        self._settle(explained)
        return done

    # --- what was recorded -------------------------------------------------------------------------------------

    def _settle(self, explained: int = 0, may_be_taken: bool = False, deaf_cycles: int = 0) -> Batch:
        """Check everything since the last call. `explained`: faults that may be seen besides those of any motion."""
        session = self._axis.session
        raw = session.raw
        session.clear()
        rows, samples = rows_of(raw), samples_of(self._drive.take())
        self._recorder.add(raw)
        self._rows.check(rows, explained | fault_bits(ALWAYS), ANSWER_CYCLES + deaf_cycles)
        self._syncs.check(rows, self._heard.take(), may_be_taken)
        self._samples.check(samples, self._drive.lost)
        return Batch(rows, samples)


def _drive_limit_nm(axis: SteppedUnderTest) -> float:
    settings = axis.world.settings
    return settings.rated_torque_mnm * settings.max_torque_permille * 1e-6 * settings.gear_ratio
