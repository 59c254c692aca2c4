"""What each verb of the control socket does: arguments checked, commands sent to the loop, the answer awaited.

Around the loop, between control server and loop handle. Nothing here blocks: what takes time is awaited, and disk
or bus work runs in one slow thread.
"""

from __future__ import annotations

import base64
import contextlib
import logging
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

from servod.common.clock import WallClock
from servod.common.errors import AnswerIsNo, Unreachable
from servod.common.faults import FAULTS, FaultCode, faults_in
from servod.common.units import NS_PER_S
from servod.formats.config import AxisConfig
from servod.formats.protocol import PIECE_CYCLES, Verb
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.arguments import (
    CyclesArgs,
    EnableArgs,
    GainsActivateArgs,
    GainsLoadArgs,
    GainsVerdictArgs,
    HaltArgs,
    NoArgs,
    RecordStartArgs,
    TrackArgs,
    TrajectoryArgs,
    check_arguments,
)
from servod.runtime.daemon.connection import Reply
from servod.runtime.daemon.gain_bank import GainBank
from servod.runtime.daemon.guard_test import GuardTestStatus, require_guard_test
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.requests import Request, Requests, SentOrder, Waits, work_of
from servod.runtime.daemon.status import reason_texts
from servod.runtime.daemon.trajectory import MotionTable, check_motion
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.bus.open import open_bus
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.fieldbus.master.scan import scan
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import REFUSAL_TEXT, Op, Refusal
from servod.runtime.loop.handle import LoopHandle
from servod.runtime.loop.wiring.findings import wiring_document, wiring_sentence

log = logging.getLogger("servod.control")

_NOT_PROVEN = FAULTS[FaultCode.WIRING_NOT_PROVEN].bit
_STOP_TIMEOUT_S = 5.0
_LEFT = GainsVerdictArgs(note="the client that tried it left", trial=True)


class Verbs:
    """Carries out requests on one running axis."""

    def __init__(
        self,
        config: AxisConfig,
        loop: LoopHandle,
        bank: GainBank,
        recorder: Recorder,
        document: Callable[[], dict[str, Any]],
        faults: Callable[[], dict[str, Any]],
        of_ours: Callable[[Bus], Bus],
        proof: Callable[[], GuardTestStatus],
    ) -> None:
        """`document` makes the status document, `faults` that of what befell the axis, `proof` that of the drive's
        guards; `of_ours` makes a connection to the bus known as one of the daemon's."""
        self._config, self._loop, self._bank, self._recorder = config, loop, bank, recorder
        self._document, self._faults, self._of_ours, self._proof = document, faults, of_ours, proof
        self._waits, self._requests = Waits(), Requests()
        self._last: tuple[Op, SentOrder] | None = None
        self._uploaded = MotionTable()
        self._reference_seq = 0  # the last motion's command
        self._renew_ns: int | None = None  # of that motion
        self.abandoned = ""  # why that motion ended before its time, when its client let go of it
        self._leases_ended = 0
        self._stopping = 0  # requests to stop without an answer yet
        self._enabling = 0  # requests to enable an axis that was off, without an answer yet
        self.slow = ThreadPoolExecutor(max_workers=1, thread_name_prefix="slow")
        self._table: dict[Verb, Callable[[Any], Request]] = {
            Verb.STATUS: self._status,
            Verb.ENABLE: self._enable,
            Verb.DISABLE: self._disable,
            Verb.STOP: self._stop,
            Verb.HALT: self._halt,
            Verb.TRAJECTORY: self._trajectory,
            Verb.TRACK: self._track,
            Verb.GAINS_LOAD: self._gains_load,
            Verb.GAINS_LIST: self._gains_list,
            Verb.GAINS_ACTIVATE: self._gains_activate,
            Verb.GAINS_KEEP: self._gains_keep,
            Verb.GAINS_ROLLBACK: self._gains_rollback,
            Verb.RECORD_START: self._record_start,
            Verb.RECORD_STOP: self._record_stop,
            Verb.SCAN: self._scan,
            Verb.FAULTS: self._fault_incidents,
            Verb.CYCLES: self._cycles,
        }

    def handle(self, verb: Verb, args: dict[str, Any], reply: Reply) -> None:
        """Begin one request; raises BadInput on arguments that do not fit."""
        self._requests.start(self._table[verb](check_arguments(verb, args)), reply)

    def status(self) -> dict[str, Any]:
        """The status document."""
        return self._document()

    def motion_running(self) -> bool:
        """A motion runs, or its command is on the way; until then the trajectory area must not change."""
        record = self._loop.latest
        return record is not None and (record.command_seq < self._reference_seq or bool(record.reference_active))

    @property
    def renew_ns(self) -> int | None:
        """How long the motion that runs goes on without a word of its client; None: for good, or there is none."""
        return self._renew_ns if not self.abandoned and self.motion_running() else None

    def abandon_motion(self, why: str) -> None:
        """Bring the reference to rest, and end the motion there; the axis stays enabled and holds."""
        with contextlib.suppress(Unreachable):  # a queue that is full now is not so in the next round
            self._send(Op.HALT, (1.0, 1.0))
            self.abandoned = f"the motion was halted: {why}"
            log.warning("%s", self.abandoned)
            self._recorder.add_event("motion", self.abandoned)

    def lease_ended(self) -> None:
        """Samples that the client sent ahead are void, a gain set that it tried is not kept, nor is an axis enabled
        that it waited for."""
        self._uploaded = MotionTable()
        self._leases_ended += 1
        if self._enabling:
            log.warning("the client that waited for the axis to be enabled left: disabled again")
            self._requests.start(self._disable(NoArgs()), Reply(lambda _answer: None, None))
        if self._bank.on_trial:
            self._requests.start(self._gains_rollback(_LEFT), Reply(lambda _answer: None, None))

    def tick(self, records: list[CycleRecord], now_ns: int) -> None:
        """Go on with everything that waited for these records, or for time."""
        self._waits.see(records, now_ns)

    def close(self) -> None:
        """Give up what has not begun."""
        self.slow.shutdown(wait=False, cancel_futures=True)

    # --- small tools of the verbs --------------------------------------------------------------------------------
    def _send(self, op: Op, arguments: Sequence[float] = ()) -> SentOrder:
        seq = self._loop.send(op, arguments)
        self._recorder.add_event("command", op.name.lower(), arguments=list(arguments[:8]))
        self._last = op, self._waits.order(seq, time.monotonic_ns())
        return self._last[1]

    def _send_stop(self, op: Op) -> SentOrder:
        """Of stops one after the other one is enough: nobody fills the queue so that another finds no room."""
        if self._last is not None:
            op_before, wait = self._last
            if op is op_before and not wait.over(time.monotonic_ns()):
                return wait
        return self._send(op)

    async def _until(self, reached: Callable[[CycleRecord], bool], timeout_s: float) -> CycleRecord:
        """Wait for a state of the axis; the newest record, also when time is up."""
        deadline_ns = time.monotonic_ns() + int(timeout_s * NS_PER_S)

        def ready(now_ns: int) -> bool:
            record = self._loop.latest
            return now_ns >= deadline_ns or (record is not None and reached(record))

        await self._waits.until(ready)
        return self._must_run()

    # --- the verbs -----------------------------------------------------------------------------------------------
    async def _status(self, _args: NoArgs) -> dict[str, Any]:
        return self._document()

    async def _fault_incidents(self, _args: NoArgs) -> dict[str, Any]:
        return self._faults()

    async def _cycles(self, args: CyclesArgs) -> dict[str, Any]:
        """A piece of what the recorder holds in memory; as text of the packed records, which costs least."""
        serial, raw = self._recorder.newest_cycle, b""
        if args.after is not None:
            serial, raw = self._recorder.cycles_after(args.after, PIECE_CYCLES)
        count_rad = 2.0 * math.pi / self._config.encoder.counts_per_turn
        return {"last": serial, "records": base64.b64encode(raw).decode(), "count_rad": count_rad}

    async def _enable(self, args: EnableArgs) -> dict[str, Any]:
        require_guard_test(self._proof())
        self._bank.require_own_devices()
        if self._stopping:  # whichever came first: two connections are not always read in the order that they wrote
            raise Unreachable("refused: somebody stops the axis at this moment; enable it once that is over")
        record = self._loop.latest
        from_off = int(record is None or not AxisState(record.axis_state).under_way)
        self._enabling += from_off
        try:
            return await self._enable_and_wait(args)
        finally:
            self._enabling -= from_off

    async def _enable_and_wait(self, args: EnableArgs) -> dict[str, Any]:
        tests_before, _ = self._loop.proofs
        asked = await self._send(Op.ENABLE, (float(args.reset_fault), float(args.prove)))
        if asked.command_result < 0:
            await self._send(Op.CONFIRM, (asked.command_result,))
        amplifier = self._config.amplifier
        times_s = amplifier.enable_timeout_s, amplifier.brake.release_s, self._config.wiring_proof.timeout_s
        timeout_s = sum(times_s) + 1.0
        record = await self._until(lambda r: not AxisState(r.axis_state).arriving, timeout_s)
        tests, proof = self._loop.proofs
        tested = proof if tests != tests_before else None
        if record.axis_state == AxisState.ENABLED:
            return {**_state(record), "wiring": wiring_document(tested) if tested else None}
        state = AxisState(record.axis_state).name
        if tested is not None and record.faults_latched & _NOT_PROVEN:
            raise AnswerIsNo(f"the axis is {state}, not enabled: {wiring_sentence(tested)}")
        raise Unreachable(f"the axis is {state}, not enabled: {_why_not_enabled(record)}")

    async def _disable(self, _args: NoArgs) -> dict[str, Any]:
        return await self._until_off(Op.DISABLE, 2.0 * self._config.limits.ramp_down_s)

    async def _stop(self, _args: NoArgs) -> dict[str, Any]:
        return await self._until_off(Op.QUICK_STOP, self._config.amplifier.enable_timeout_s)

    async def _until_off(self, op: Op, usual_s: float) -> dict[str, Any]:
        """Done only when the axis has stopped and the drive itself was seen without power; nobody enables it before."""
        self._stopping += 1
        try:
            await self._send_stop(op)
            timeout_s = usual_s + self._config.amplifier.brake.engage_s + _STOP_TIMEOUT_S
            record = await self._until(_is_off, timeout_s)
        finally:
            self._stopping -= 1
        if not _is_off(record):
            axis, drive = AxisState(record.axis_state).name, DriveState(record.drive_state).name
            heard = f"heard {record.amplifier_age} cycles ago" if record.amplifier_age else "heard now"
            raise Unreachable(f"not off: the axis is {axis}, the drive {drive} ({heard}): {_why(record)}")
        return _state(record)

    async def _halt(self, args: HaltArgs) -> dict[str, Any]:
        record = await self._send(Op.HALT, (float(args.on),))
        return _state(record)

    async def _trajectory(self, args: TrajectoryArgs) -> dict[str, Any]:
        self._uploaded.add(args.key, args.start, args.samples)
        return {"samples": args.start + len(args.samples)}

    async def _track(self, args: TrackArgs) -> dict[str, Any]:
        table = args.table(self._uploaded)
        reference = args.reference(table)
        duration_s = self._duration_s(args, table)
        if not args.start_immediately:
            check_motion(reference, table, self._config, self._must_run())
            return {"kind": args.kind, "duration_s": duration_s}
        self._refuse_if_not_free()
        check_motion(reference, table, self._config, self._must_run())
        if args.has_table:
            self._loop.write_trajectory(table.area())
        wait = self._send(Op.REFERENCE, reference)
        self._reference_seq, self.abandoned = wait.seq, ""
        self._renew_ns = None if args.renew_s is None else round(args.renew_s * NS_PER_S)
        record = await wait
        return {**_state(record), "kind": args.kind, "duration_s": duration_s}

    def _must_run(self) -> CycleRecord:
        """The newest record."""
        record = self._loop.latest
        if record is None:
            raise Unreachable("the loop has not begun")
        return record

    def _refuse_if_not_free(self) -> None:
        """The trajectory area must not change under a motion that runs or is about to; the loop checks the rest."""
        if self._must_run().axis_state != AxisState.ENABLED:
            raise Unreachable(f"refused: {REFUSAL_TEXT[Refusal.NOT_ENABLED]}")
        if self.motion_running():
            raise Unreachable(f"refused: {REFUSAL_TEXT[Refusal.MOTION_RUNNING]}")

    def _duration_s(self, args: TrackArgs, table: MotionTable) -> float:
        if args.has_table:
            return (len(table.positions.values) - 1) * self._config.cycle.period_us * 1e-6
        return args.duration_s or 0.0

    async def _gains_load(self, args: GainsLoadArgs) -> dict[str, Any]:
        return await self._bank.load(args, self.slow)

    async def _gains_list(self, _args: NoArgs) -> dict[str, Any]:
        record = self._loop.latest
        return await self._bank.list(record.controller if record else 0, self.slow)

    async def _gains_activate(self, args: GainsActivateArgs) -> dict[str, Any]:
        """A trial whose client left before it began ends at once."""
        leases = self._leases_ended
        result = await self._attach_gains(self._bank.activate(args, self._send, self.slow))
        if args.trial and self._leases_ended != leases:
            await self._gains_rollback(_LEFT)
        return result

    async def _gains_keep(self, args: GainsVerdictArgs) -> dict[str, Any]:
        return await self._attach_gains(self._bank.keep(args, self._send, self.slow))

    async def _gains_rollback(self, args: GainsVerdictArgs) -> dict[str, Any]:
        return await self._attach_gains(self._bank.rollback(args, self._send, self.slow))

    async def _attach_gains(self, change: Request) -> dict[str, Any]:
        """After a change of the gain set, also one back when it failed, the recording gets the one that runs."""
        before = self._bank.newest
        try:
            return await change
        finally:
            if self._bank.newest is not before:
                self._recorder.set_attachment("gains.yaml", self._bank.newest.text.encode())

    async def _record_start(self, args: RecordStartArgs) -> dict[str, Any]:
        path = await work_of(self._recorder.start(args.path))
        return {"path": str(path)}

    async def _record_stop(self, _args: NoArgs) -> dict[str, Any]:
        state = await work_of(self._recorder.stop())
        return dict(state)

    async def _scan(self, _args: NoArgs) -> dict[str, Any]:
        record = self._loop.latest
        if record is None or not AxisState(record.axis_state).stopped:
            raise Unreachable("refused: scanning needs the axis disabled; run `servoctl disable` first")
        nodes = await work_of(self.slow.submit(self._scan_bus))
        return {"nodes": nodes}

    def _scan_bus(self) -> list[dict[str, Any]]:
        """In the slow thread, on a connection of its own, which `scan` closes; no LSS beside a running loop."""
        return [asdict(node) for node in scan(self._of_ours(open_bus(self._config.bus)), WallClock(), lss=False)]


def _state(record: CycleRecord) -> dict[str, Any]:
    return {"state": AxisState(record.axis_state).name}


def _is_off(record: CycleRecord) -> bool:
    """The axis has stopped, and the drive says so itself, in this cycle."""
    stopped, drive = AxisState(record.axis_state).stopped, DriveState(record.drive_state)
    return stopped and record.amplifier_age == 0 and drive.unpowered


def _why_not_enabled(record: CycleRecord) -> str:
    """An axis on its way that is off without a fault was switched off by a command."""
    if record.axis_state == AxisState.DISABLED and not record.faults_latched:
        return "somebody stopped it meanwhile (`servoctl stop` or `servoctl disable`)"
    return _why(record)


def _why(record: CycleRecord) -> str:
    """Faults, or else what the drive waits for."""
    faults = [f"{f.code.name}: {f.cause} {f.remedy}" for f in faults_in(record.faults_latched)]
    return " ".join(faults or reason_texts(record.reasons) or ["no reason given"])
