"""A soak on the wall clock: daemon, loop and virtual axis as the processes that ship, driven through the schedule.

The rows are those that the daemon's recorder wrote, read back file by file; SYNC is counted by a client of the hub of
its own; the drive's record is read while it grows. What a machine that does not give the processes their turn may cause
is excused where the kernel's own count says that they had to wait, and counted.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from pathlib import Path
from typing import Any

from servod.common.errors import AnswerIsNo, ServodError, Unreachable
from servod.common.faults import FaultCode
from servod.common.shipped import shipped
from servod.common.units import NS_PER_US
from servod.drivers.virtual.drive_record import DriveTail
from servod.formats.protocol import Verb
from servod.qualify.faults.actions import action_of
from servod.qualify.faults.actions.bus import FrameFault
from servod.qualify.faults.machine import Process
from servod.qualify.faults.processes import ProcessAxis
from servod.qualify.faults.scenario import Injection, Recovery, Runs, ScenarioStart
from servod.qualify.soak.drive import DriveCheck, check_reaction, check_trace, reaction_in, samples_of
from servod.qualify.soak.kinds import ALWAYS, InjectionKind, fault_bits
from servod.qualify.soak.plan import Episode, Move, SoakEnding, nothing_yet
from servod.qualify.soak.rows import RecordedRows
from servod.qualify.soak.starvation import STARVED_CYCLE, STARVED_SUPERVISOR, ExcusedFaults, Starvation
from servod.qualify.soak.syncs import SyncThread
from servod.qualify.soak.tally import Counts, Findings, Tally, Wrong
from servod.qualify.soak.traces import LISTEN_S, BusListener, trace_of
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import ReferenceKind

#: Actions that happen within the loop's process.
_INSIDE = ("gains", "interface_down")
_POLL_S, _STOPPING_S, _TRIES = 0.05, 5.0, 3
#: Whoever hears SYNC has heard the last one so long after the loop ended [s].
_HEARD_S = 0.2
#: Exit codes of a daemon that ends after a node was lost: 3 when it could not see the drive off.
_ENDS_AFTER_LOSS = (0, Unreachable.exit_code)
#: Timers of the virtual axis are stamped with the moment at which they were due, frames with that of the bus [ns].
_ORDER_NS = 500_000_000
#: What every bound is longer by: feedback is missed after 50 cycles here, not 20, and an injection goes through a
#: process [ms].
_GRACE_MS = 60.0


def of_the_wall(kind: InjectionKind) -> bool:
    """Whether a fault can be put to a loop in a process of its own, from the bus and not from within, and be seen
    there: a client of the hub hears of no frame that was destroyed."""
    return all(
        name not in _INSIDE and arguments.get("who") != "loop" and arguments.get("fault") != FrameFault.DESTROY
        for name, arguments in kind.do.items()
    )


class WallSoak:
    """One axis of real processes; `folder` takes everything that they write."""

    def __init__(self, seed: int, folder: Path) -> None:
        """Raises Unreachable when the processes do not start."""
        folder.mkdir(parents=True, exist_ok=True)
        self.findings, self.tally = Findings(), Tally()
        self._schedule, self._starvation = ExcusedFaults(fault_bits(ALWAYS)), Starvation(time.monotonic_ns())
        over = {"recorder": {"always": True, "max_file_mib": 16}}
        with contextlib.ExitStack() as stack:
            self._axis = ProcessAxis(nothing_yet(seed, proves=False), folder, over=over)
            stack.callback(self._axis.close)
            self._axis.start(ScenarioStart.OFF)
            self._bus = folder / "bus"
            self._heard = SyncThread(self._bus)
            stack.callback(self._heard.close)
            self._tail = DriveTail(next(folder.glob("*-drive.bin")))
            stack.callback(self._tail.close)
            self._axis.machine.start_daemon()
            self._ends = stack.pop_all()
        config = self._axis.config
        self._period_ns = config.cycle.period_us * NS_PER_US
        self._rows = RecordedRows(config, self.findings)
        self._samples = DriveCheck(config.limits.torque_nm, self.findings, _ORDER_NS)
        self._heard_before = self._overruns_before = 0
        self._syncs_taken = False
        self.findings.begin(self._axis.now_ns())
        self._recover(Recovery.ENABLE)

    @property
    def counts(self) -> Counts:
        """What was counted so far; rows are counted when their file is complete."""
        rows, check = self._rows, self._rows.check
        return Counts(
            self._period_ns,
            check.cycles,
            check.rows,
            check.missed,
            rows.syncs,
            rows.syncs_taken,
            self._samples.samples,
            rows.files,
            check.rows,
        )

    def processes(self) -> dict[str, int]:
        """Daemon, virtual axis and this one."""
        machine = self._axis.machine
        assert machine.daemon is not None and machine.virtual_axis is not None
        return {"soak": os.getpid(), "daemon": machine.daemon.pid, "virtual axis": machine.virtual_axis.pid}

    def episode(self, episode: Episode) -> None:
        """Let one episode happen. Raises AnswerIsNo when the axis cannot be enabled any more, by nothing."""
        self.findings.episode = episode.number
        self.tally.episodes += 1
        if episode.law is not None:
            self._change_law(episode.law)
        moves = self._move(episode.move)
        time.sleep(episode.before_s)
        self._settle()
        if episode.fault is not None:
            self._befall(episode.fault, random.Random(episode.seed))  # noqa: S311
        if moves and self._state() == AxisState.ENABLED.name:
            self._end(episode)
        self._starvation.look(self._watched(), self._axis.now_ns())
        self._rows.take(self._schedule, self._starvation.explained, ended=False)

    def finish(self) -> None:
        """Bring the axis to rest, end the daemon and check what it recorded last."""
        self._end_session((0,))

    def close(self) -> None:
        """End all processes."""
        self._ends.close()

    # --- what happens ------------------------------------------------------------------------------------------

    def _ask(self, verb: Verb, **args: Any) -> bool:
        """Ask the daemon; a refusal of a sound axis is a finding, that of a starved one is none."""
        try:
            self._axis.client.call(verb, **args)
        except ServodError as error:
            if self._state() == AxisState.ENABLED.name:
                self.findings.add(Wrong.REFUSED, self._axis.now_ns(), f"{verb}: {error}")
            return False
        return True

    def _state(self) -> str:
        return str(self._axis.client.call(Verb.STATUS)["axis"]["state"])

    def _change_law(self, name: str) -> None:
        text = shipped(f"gains/{name}.yaml").read_text(encoding="utf-8")
        if self._ask(Verb.GAINS_LOAD, name=f"{name}.yaml", text=text) and self._ask(Verb.GAINS_ACTIVATE, name=name):
            self.tally.laws[name] += 1

    def _move(self, move: Move) -> bool:
        self.tally.moves[move.kind.name] += 1
        arguments = _track(move)
        return arguments is not None and self._ask(Verb.TRACK, renew_s=None, **arguments)

    def _end(self, episode: Episode) -> None:
        self.tally.endings[episode.ending.name] += 1
        if episode.ending in (SoakEnding.DISABLE, SoakEnding.QUICK_STOP):
            self._ask(Verb.DISABLE if episode.ending is SoakEnding.DISABLE else Verb.STOP)
            self._wait_while(lambda status: status["axis"]["state"] not in ("DISABLED", "FAULT"))
            self._recover(Recovery.ENABLE)
            return
        if episode.ending is SoakEnding.HALT:
            self._ask(Verb.HALT, on=True)
            time.sleep(0.2)
            self._ask(Verb.HALT, on=False)
        self._wait_while(lambda status: bool(status["axis"]["motion_running"]))
        self._settle()

    def _wait_while(self, goes_on: Any) -> None:
        deadline = time.monotonic() + _STOPPING_S
        while goes_on(self._axis.client.call(Verb.STATUS)) and time.monotonic() < deadline:
            time.sleep(_POLL_S)

    # --- faults ------------------------------------------------------------------------------------------------

    def _befall(self, kind: InjectionKind, chance: random.Random) -> None:
        """Inject, watch, judge, repair, recover."""
        tally = self.tally.of(kind.name)
        tally.injected += 1
        tally.due += bool(kind.expects)
        self._syncs_taken |= kind.takes_syncs
        injection = kind.injection(chance)
        listener = None if kind.expects else self._listen(injection)
        self._starvation.look(self._watched(), self._axis.now_ns())
        injected_ns = self._axis.now_ns()
        self._schedule.add(injected_ns, kind.explained)
        self._act(injection)
        happened = _watch(kind.watch_ms / 1e3, listener)
        self._judge(kind, injected_ns, happened)
        repair = kind.repair()
        if repair is not None:
            self._act(repair)
            time.sleep(_HEARD_S)
        back = self._recover(kind.recovery)
        tally.recovered += back
        tally.ridden += back and happened and not kind.expects
        self._schedule.end(self._axis.now_ns())

    def _listen(self, injection: Injection) -> BusListener | None:
        """Listen for what will show that it happened, from some time before; None where nothing would."""
        trace = trace_of(action_of(injection, "soak", Runs.PROCESSES))
        if trace is None:
            return None
        listener = BusListener(self._bus, trace)
        listener.listen(LISTEN_S)
        return listener

    def _act(self, injection: Injection) -> None:
        action_of(injection, "soak", Runs.PROCESSES).apply(self._axis)

    def _judge(self, kind: InjectionKind, injected_ns: int, happened: bool) -> None:
        """Does the user see the fault, and was the torque gone in time by the drive's own record?

        Of what is ridden through no fault word tells; there must be its trace.
        """
        tally, samples = self.tally.of(kind.name), self._settle()
        seen = {FaultCode[fault["code"]] for fault in self._axis.client.call(Verb.STATUS)["faults"]}
        tally.latched.update(code.name for code in seen)
        if not kind.expects:
            check_trace(kind, happened, injected_ns, self.findings)
            return
        if not seen & kind.expects:
            self.findings.add(
                Wrong.NOT_FOUND, injected_ns, f"{kind.name}: {', '.join(c.name for c in seen) or 'nothing'}"
            )
            return
        tally.found += 1
        waited_ms = self._starvation.waited_ms(self._watched())
        times = reaction_in(samples, injected_ns)
        if check_reaction(kind, times, injected_ns, tally, self.findings, _GRACE_MS, waited_ms):
            self.tally.excused["reaction later than its bound"] += 1

    def _recover(self, recovery: Recovery) -> bool:
        """What a person does; only a machine that starves the processes may need another try without a finding.

        Returns whether the first try did it.
        """
        starved, why = False, ""
        for attempt in range(_TRIES):
            starved = starved or self._starvation.is_starved(self._watched())
            if recovery is Recovery.RESTART or attempt == _TRIES - 1:
                self._end_session(_ENDS_AFTER_LOSS)
                self.tally.restarts += 1
                self._axis.machine.start_daemon()
            if self._enabled(recovery is not Recovery.NONE or attempt > 0):
                self._report_tries(recovery, attempt, starved, why)
                return attempt == 0
            why = why or self._axis.refusal or self._faults()
        self.findings.add(Wrong.NOT_RECOVERED, self._axis.now_ns(), f"by {recovery}: {self._axis.refusal}")
        raise AnswerIsNo(f"episode {self.findings.episode}: the axis cannot be enabled any more")

    def _report_tries(self, recovery: Recovery, attempt: int, starved: bool, why: str) -> None:
        """More than one try is a finding, unless the processes were starved; then it is counted."""
        if attempt and starved:
            self.tally.excused["recovered by another try"] += 1
        elif attempt:
            text = f"not by {recovery}, but at try {attempt + 1} of {_TRIES}: {why}"
            self.findings.add(Wrong.NOT_RECOVERED, self._axis.now_ns(), text)

    def _faults(self) -> str:
        return ", ".join(fault["code"] for fault in self._axis.client.call(Verb.STATUS)["faults"])

    def _enabled(self, ask: bool) -> bool:
        done = self._axis.recover(Recovery.RESET_FAULT) if ask else self._state() == AxisState.ENABLED.name
        self._settle()
        return done

    # --- what was recorded -------------------------------------------------------------------------------------

    def _settle(self) -> Any:
        """Check the drive's own record since the last call; returns its samples."""
        samples = samples_of(self._tail.take())
        self._samples.check(samples, self._tail.lost)
        return samples

    def _watched(self) -> dict[int, frozenset[FaultCode]]:
        """The processes that the axis needs, and the loop's while it can be asked for; what their waiting may cause."""
        pids = self.processes()
        watched = {pids["daemon"]: STARVED_SUPERVISOR, pids["virtual axis"]: STARVED_CYCLE}
        with contextlib.suppress(ServodError):
            watched[int(self._axis.client.call(Verb.STATUS)["loop"]["pid"])] = STARVED_CYCLE
        return watched

    def _end_session(self, codes: tuple[int, ...]) -> None:
        """End the daemon as the service manager does, and hold its rows against what was heard on the bus."""
        machine = self._axis.machine
        self._starvation.look(self._watched(), self._axis.now_ns())
        self._axis.leave()
        machine.send([Process.DAEMON], signal.SIGTERM)
        code = machine.wait(Process.DAEMON, 20.0)
        if code not in codes:
            self.findings.add(Wrong.STATE, self._axis.now_ns(), f"the daemon ended with exit code {code}")
        time.sleep(_HEARD_S)
        self._starvation.look(self._watched(), self._axis.now_ns())
        heard, self._heard_before = self._heard.count - self._heard_before, self._heard.count
        overruns, self._overruns_before = self._heard.overruns - self._overruns_before, self._heard.overruns
        self._rows.take(self._schedule, self._starvation.explained, ended=True)
        self._rows.end_session(heard, self._syncs_taken or overruns > 0)
        self.tally.excused.update({"SYNC heard by a listener that was too slow": overruns} if overruns else {})
        self.tally.excused.update(self._rows.excused)
        self._rows.excused.clear()
        self._syncs_taken = False
        self._schedule.forget(self._axis.now_ns())
        self._starvation.explained.forget(self._axis.now_ns())


def _watch(duration_s: float, listener: BusListener | None) -> bool:
    """Let time pass; whether the trace was there that one listened for."""
    if listener is None:
        time.sleep(duration_s)
        return False
    listener.listen(duration_s)
    return listener.leave()


_NAMES: dict[ReferenceKind, tuple[str, ...]] = {
    ReferenceKind.SINE: ("amplitude_rad", "frequency_hz", "duration_s"),
    ReferenceKind.STEP: ("amplitude_rad", "duration_s"),
    ReferenceKind.PAPER: ("duration_s",),
}


def _track(move: Move) -> dict[str, Any] | None:
    """Arguments of the verb `track`; None for holding still, which needs no command."""
    if move.kind is ReferenceKind.HOLD:
        return None
    if move.table:
        return {"kind": "csv", "positions_rad": list(move.table[: int(move.arguments[0])])}
    return {"kind": move.kind.name.lower(), **dict(zip(_NAMES[move.kind], move.arguments, strict=True))}
