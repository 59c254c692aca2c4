"""What each verb of the control socket does: arguments checked, commands sent to the loop, the answer awaited.

Around the loop, between control server and loop handle. Nothing here blocks: what takes time is a flow, and disk or bus
work runs in one slow thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

from servod.axis import AxisState
from servod.bus.open import open_bus
from servod.clock import WallClock
from servod.commands import REFUSAL_TEXT, Op, Refusal
from servod.config import AxisConfig
from servod.control import Verb
from servod.daemon.arguments import (
    EnableArgs,
    GainsActivateArgs,
    GainsLoadArgs,
    HaltArgs,
    NoArgs,
    RecordStartArgs,
    TrackArgs,
    check_arguments,
)
from servod.daemon.control_server import Reply
from servod.daemon.flows import Flow, Flows, FutureWait, Orders, StateWait, Wait
from servod.daemon.gain_bank import GainBank
from servod.daemon.status import reason_texts
from servod.errors import Unreachable, faults_in
from servod.loop.handle import LoopHandle
from servod.master.scan import scan
from servod.record import CycleRecord
from servod.recorder import Recorder
from servod.units import NS_PER_S

_STOPPED = (AxisState.DISABLED, AxisState.FAULT)
_STOP_TIMEOUT_S = 5.0


class Verbs:
    """Carries out requests on one running axis."""

    def __init__(
        self,
        config: AxisConfig,
        loop: LoopHandle,
        bank: GainBank,
        recorder: Recorder,
        document: Callable[[], dict[str, Any]],
    ) -> None:
        """`document` makes the status document."""
        self._config, self._loop, self._bank, self._recorder = config, loop, bank, recorder
        self._document = document
        self._orders, self._flows = Orders(), Flows()
        self.slow = ThreadPoolExecutor(max_workers=1, thread_name_prefix="slow")
        self._table: dict[Verb, Callable[[Any], Flow]] = {
            Verb.STATUS: self._status,
            Verb.ENABLE: self._enable,
            Verb.DISABLE: self._disable,
            Verb.STOP: self._stop,
            Verb.HALT: self._halt,
            Verb.TRACK: self._track,
            Verb.GAINS_LOAD: self._gains_load,
            Verb.GAINS_LIST: self._gains_list,
            Verb.GAINS_ACTIVATE: self._gains_activate,
            Verb.GAINS_ROLLBACK: self._gains_rollback,
            Verb.RECORD_START: self._record_start,
            Verb.RECORD_STOP: self._record_stop,
            Verb.SCAN: self._scan,
        }

    def handle(self, verb: Verb, args: dict[str, Any], reply: Reply) -> None:
        """Begin one request; raises BadInput on arguments that do not fit."""
        self._flows.start(self._table[verb](check_arguments(verb, args)), reply)

    def status(self) -> dict[str, Any]:
        """The status document."""
        return self._document()

    def tick(self, records: list[CycleRecord], now_ns: int) -> None:
        """Go on with everything that waited for these records, or for time."""
        self._orders.see(records, now_ns)
        self._flows.poll(now_ns)

    def close(self) -> None:
        """Give up what has not begun."""
        self.slow.shutdown(wait=False, cancel_futures=True)

    # --- small tools of the flows --------------------------------------------------------------------------------
    def _send(self, op: Op, arguments: Sequence[float] = ()) -> Wait:
        seq = self._loop.send(op, arguments)
        self._recorder.add_event("command", op.name.lower(), arguments=list(arguments[:8]))
        return self._orders.expect(seq, time.monotonic_ns())

    def _latest(self) -> CycleRecord | None:
        return self._loop.latest

    def _until(self, reached: Callable[[CycleRecord], bool], timeout_s: float) -> StateWait:
        return StateWait(self._latest, reached, time.monotonic_ns() + int(timeout_s * NS_PER_S))

    # --- the verbs -----------------------------------------------------------------------------------------------
    def _status(self, _args: NoArgs) -> Flow:
        yield from ()
        return self._document()

    def _enable(self, args: EnableArgs) -> Flow:
        yield self._send(Op.ENABLE, (float(args.reset_fault),))
        timeout_s = self._config.amplifier.enable_timeout_s + 1.0
        record: CycleRecord = yield self._until(lambda r: r.axis_state != AxisState.ENABLING, timeout_s)
        if record.axis_state != AxisState.ENABLED:
            raise Unreachable(f"the axis is {AxisState(record.axis_state).name}, not enabled: {_why(record)}")
        return _state(record)

    def _disable(self, _args: NoArgs) -> Flow:
        yield self._send(Op.DISABLE)
        timeout_s = self._config.limits.ramp_down_s + _STOP_TIMEOUT_S
        record: CycleRecord = yield self._until(lambda r: r.axis_state in _STOPPED, timeout_s)
        if record.axis_state not in _STOPPED:
            raise Unreachable(f"the axis is still {AxisState(record.axis_state).name}: {_why(record)}")
        return _state(record)

    def _stop(self, _args: NoArgs) -> Flow:
        yield self._send(Op.QUICK_STOP)
        record: CycleRecord = yield self._until(lambda r: r.axis_state in _STOPPED, _STOP_TIMEOUT_S)
        return _state(record)

    def _halt(self, args: HaltArgs) -> Flow:
        record = yield self._send(Op.HALT, (float(args.on),))
        return _state(record)

    def _track(self, args: TrackArgs) -> Flow:
        self._refuse_if_not_free()
        if not args.start_immediately:
            return {"kind": args.kind, "duration_s": self._duration_s(args)}
        if args.positions_rad is not None:
            self._loop.write_trajectory(args.area())
        record = yield self._send(Op.REFERENCE, args.reference())
        return {**_state(record), "kind": args.kind, "duration_s": self._duration_s(args)}

    def _refuse_if_not_free(self) -> None:
        """The trajectory area must not change under a running motion; the loop checks the rest again."""
        record = self._loop.latest
        if record is None or record.axis_state != AxisState.ENABLED:
            raise Unreachable(f"refused: {REFUSAL_TEXT[Refusal.NOT_ENABLED]}")
        if record.reference_active:
            raise Unreachable(f"refused: {REFUSAL_TEXT[Refusal.MOTION_RUNNING]}")

    def _duration_s(self, args: TrackArgs) -> float:
        if args.positions_rad is not None:
            return (len(args.positions_rad) - 1) * self._config.cycle.period_us * 1e-6
        return args.duration_s or 0.0

    def _gains_load(self, args: GainsLoadArgs) -> Flow:
        return self._bank.load(args, self.slow)

    def _gains_list(self, _args: NoArgs) -> Flow:
        record = self._loop.latest
        return self._bank.list(record.controller if record else 0, self.slow)

    def _gains_activate(self, args: GainsActivateArgs) -> Flow:
        return self._attach_gains(self._bank.activate(args, self._send, self.slow))

    def _gains_rollback(self, _args: NoArgs) -> Flow:
        return self._attach_gains(self._bank.rollback(self._send, self.slow))

    def _attach_gains(self, change: Flow) -> Flow:
        """After a change of the gain set, the recording gets the new one too."""
        result = yield from change
        self._recorder.set_attachment("gains.yaml", self._bank.newest.path.read_bytes())
        return result

    def _record_start(self, args: RecordStartArgs) -> Flow:
        path = yield FutureWait(self._recorder.start(args.path))
        return {"path": str(path)}

    def _record_stop(self, _args: NoArgs) -> Flow:
        state = yield FutureWait(self._recorder.stop())
        return dict(state)

    def _scan(self, _args: NoArgs) -> Flow:
        record = self._loop.latest
        if record is None or record.axis_state not in _STOPPED:
            raise Unreachable("refused: scanning needs the axis disabled; run `servoctl disable` first")
        nodes = yield FutureWait(self.slow.submit(self._scan_bus))
        return {"nodes": nodes}

    def _scan_bus(self) -> list[dict[str, Any]]:
        """In the slow thread, on a connection of its own, which `scan` closes; no LSS beside a running loop."""
        return [asdict(node) for node in scan(open_bus(self._config.bus), WallClock(), lss=False)]


def _state(record: CycleRecord) -> dict[str, Any]:
    return {"state": AxisState(record.axis_state).name}


def _why(record: CycleRecord) -> str:
    """Faults, or else what the drive waits for."""
    faults = [f"{f.code.name}: {f.cause} {f.remedy}" for f in faults_in(record.faults_latched)]
    return " ".join(faults or reason_texts(record.reasons) or ["no reason given"])
