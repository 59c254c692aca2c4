"""The supervisor's event loop: what the loop process wrote comes in, what people want goes out, nothing ever waits.

Around the loop. One round every TICK_S: records to recorder, metrics, health and faults; node events to the loop;
requests a step further; watchdog and status line to systemd, fed only while the loop's cycle counter advances.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

from servod import __version__
from servod.common.errors import Unreachable
from servod.common.faults import FAULTS, FaultCode
from servod.common.units import NS_PER_S
from servod.formats.config import AxisConfig
from servod.formats.recording.incidents import Incident
from servod.formats.recording.record import RECORD, CycleRecord
from servod.formats.stopping import Stopping
from servod.runtime.daemon.control_server import ControlServer
from servod.runtime.daemon.fault_watch import FaultWatch, WiringTestWatch
from servod.runtime.daemon.gain_bank import GainBank
from servod.runtime.daemon.health import Health, Pulse, StandingLoop
from servod.runtime.daemon.lock import InstanceLock
from servod.runtime.daemon.metrics import AxisMetrics, MetricsServer
from servod.runtime.daemon.nodes import FaultRelay, Nodes
from servod.runtime.daemon.notify import Notifier
from servod.runtime.daemon.promise import Expected, PromiseWatch
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.status import (
    Freshness,
    Status,
    axis_status,
    brake_status,
    bus_status,
    drive_status,
    fault_status,
    inputs_status,
    motion_status,
)
from servod.runtime.daemon.verbs import Verbs
from servod.runtime.daemon.waiting import STARTS_AGAIN, Comeback, carried_by
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.fieldbus.master.planned import reaction_s
from servod.runtime.fieldbus.master.sdo import SDO_TIMEOUT_S
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.cycle import GOODBYE_TIMEOUT_S
from servod.runtime.loop.handle import LoopHandle

log = logging.getLogger("servod")

TICK_S = 0.02
#: For an orderly end, on top of what loop and drive may take.
_STOP_MARGIN_S = 2.0
#: Quick stop, brake, voltage off and brake again, none of them answered.
_SILENT_S = 4 * SDO_TIMEOUT_S
#: For a loop whose connection may be dead to see the drive off once more, before the axis begins again.
_LEAVE_S = 0.5
#: The longest that the manager's watchdog waits from there to the first round of the next supervisor: both nodes are
#: reset and brought up by some two hundred SDO transfers.
_RESTART_S = 60.0
_STATUS_NS = NS_PER_S
_TEXTFILE_NS = 5 * NS_PER_S
_STAYS_POWERED = FAULTS[FaultCode.DRIVE_STAYS_POWERED].bit


class Context(NamedTuple):
    """What outlives the supervisor, in a daemon whose axis begins again.

    `incidents` is what befell the axis; with `shown_s`, one that lost bus or nodes begins again once they are back and
    its fault was shown for so long. `found` befell it before this start, and was found at it; the faults `carried`,
    as bits, are latched from before.
    """

    lock: InstanceLock
    notifier: Notifier
    incidents: deque[Incident]
    shown_s: float | None = None
    found: Incident | None = None
    carried: int = 0


class Supervisor:
    """One running axis; `run` returns the exit code."""

    def __init__(
        self,
        config: AxisConfig,
        stopping: Stopping | None,
        nodes: Nodes,
        loop: LoopHandle,
        bank: GainBank,
        recorder: Recorder,
        context: Context,
    ) -> None:
        """The nodes are up and the loop runs. Raises Unreachable or BadInput when a socket cannot be opened."""
        self._config, self._stated_stop, self._nodes, self._loop = config, stopping, nodes, loop
        self._bank, self._recorder, self._notifier = bank, recorder, context.notifier
        self._started = time.monotonic()
        self._stopping = self._textfile_failed = self._lock_lost = False
        self._lock = context.lock
        self._switched_off = False
        self._why_ends = "servod was asked to end"
        self._relay = FaultRelay(loop.send)
        self._fed_cycle = -1
        self._next_feed_ns = self._next_status_ns = self._next_textfile_ns = 0
        self._pulse = Pulse(config.cycle.period_us)
        self._standing = StandingLoop(reaction_s(config, nodes.plans.amplifier))
        self._drive_misses_loop = False  # in this round, that it misses the loop
        self._health = Health(config.cycle.period_us, nodes.plans.bus_load)
        self._metrics = AxisMetrics(config.name, nodes.plans.bus_load)
        self.carried = 0  # faults that stay latched when the axis begins again
        self._faults = FaultWatch(
            recorder, self._health, self._metrics, config.name, context.incidents, context.carried
        )
        if context.found is not None:
            self._faults.add_earlier(context.found)
        self._proofs = WiringTestWatch(loop, recorder)
        self._promise = PromiseWatch()
        self._metrics.joint = lambda: self._promise.status()["joint"]
        self._verbs = Verbs(config, loop, bank, recorder, self._document, self._incidents, nodes.of_ours, nodes.proof)
        self._comeback = (
            Comeback(config, self._verbs.slow, nodes.of_ours, context.shown_s, context.carried)
            if context.shown_s is not None
            else None
        )
        self._server = ControlServer(config.control, self._verbs, loop.feed)
        self._metrics_server = MetricsServer(config.metrics, self._metrics)

    def request_stop(self) -> None:
        """Ask for an orderly end; for signal handlers."""
        self._stopping = True

    @property
    def stopping(self) -> bool:
        """An orderly end was asked for."""
        return self._stopping

    def run(self) -> int | None:
        """Supervise until asked to stop (0), until the loop is lost (3), or until the axis shall begin again (None)."""
        return asyncio.run(self._supervise())

    async def _supervise(self) -> int | None:
        self._server.begin()
        self._notifier.ready(f"{self._config.name}: the loop runs, the axis is disabled")
        try:
            while not self._stopping:
                self._round(time.monotonic_ns())
                if self._loop_is_lost():
                    return self._lose_loop()
                if self._comeback and self._comeback.see(self._loop.latest, time.monotonic_ns()):
                    self._leave_for_new()
                    return None
                await asyncio.sleep(0.5 * TICK_S)
                self._take_node_events()  # twice a round: what others send shall be a fault within 50 ms
                await asyncio.sleep(0.5 * TICK_S)
            return self._stop()
        finally:
            self._close()

    def _round(self, now_ns: int) -> None:
        """Everything that is done once per round."""
        self._loop.feed()
        records = self._take_records(now_ns)
        self._pulse.look(bool(records), now_ns)
        self._take_node_events()
        self._stop_past_standing_loop(bool(records), now_ns)
        self._switch_off_if_disobeyed(records)
        self._verbs.tick(records, now_ns)
        self._faults.tick(now_ns)
        self._proofs.see()
        self._server.tick(now_ns)
        self._notify_manager(now_ns)
        self._write_textfile(now_ns)

    def _take_records(self, now_ns: int) -> list[CycleRecord]:
        rows = self._loop.drain()
        records = [CycleRecord._make(values) for values in RECORD.iter_unpack(b"".join(rows))]
        self._recorder.add_rows(rows)
        self._health.add(records)
        self._metrics.count(records)
        self._metrics.records_lost = self._loop.lost
        self._faults.see(records, now_ns)
        self._hold_to_promise(records)
        if failure := self._recorder.take_failure():
            self._faults.raise_own(FaultCode.RECORDER_FAILED, failure)
        return records

    def _hold_to_promise(self, records: list[CycleRecord]) -> None:
        """Tell of a joint that the running set is not certified for any more; its limits and faults are the loop's.

        What stops nothing shall end nothing either: should it fail, it is told once, and off until another set runs.
        """
        try:
            self._look_at_promise(records)
        except Exception:
            log.exception("the look whether the joint is as certified failed in a way that nobody expected")
            self._promise.begin(self._promise.serial, None)

    def _look_at_promise(self, records: list[CycleRecord]) -> None:
        if records and records[-1].controller != self._promise.serial:
            gains = self._bank.gains_of(records[-1].controller)
            self._promise.begin(records[-1].controller, None if gains is None else Expected.of(gains))
        for sentence in self._promise.see(records):
            self._faults.raise_own(FaultCode.PROMISE_BROKEN, sentence)

    def _take_node_events(self) -> None:
        """Node events, and what came corrupt from the loop, become faults of the loop in its next cycle."""
        self._note_node_events()
        if self._loop.take_corrupt():
            log.error("what the loop wrote into the shared memory came corrupt (%s)", FaultCode.CHANNEL_CORRUPT.name)
            self._relay.add(FaultCode.CHANNEL_CORRUPT)
        self._relay.flush()

    def _note_node_events(self) -> None:
        for event in self._nodes.events():
            log.error("%s (%s)", event.text, event.fault.name)
            self._recorder.add_event("node", event.text, node_id=event.node_id, fault=event.fault.name)
            self._relay.add(event.fault)
            self._drive_misses_loop = self._drive_misses_loop or self._nodes.misses_loop(event)

    def _stop_past_standing_loop(self, wrote: bool, now_ns: int) -> None:
        """The drive stops by itself or holds its last torque, and the brake is open: at once, beside the rounds. A loop
        that wakes is told; one that does not is lost (`_loop_is_lost`)."""
        misses_loop, self._drive_misses_loop = self._drive_misses_loop, False
        latest = self._loop.latest
        if not self._standing.look(wrote, misses_loop, now_ns) or latest is None:
            return
        if AxisState(latest.axis_state).stopped and not DriveState(latest.drive_state).commanded:
            return
        missed = " and the drive misses it" if misses_loop else ""
        log.error("the loop stands still%s: stopping the drive by SDO", missed)
        self._relay.add(FaultCode.LOOP_LOST)
        self._beside(self._nodes.stop_past_loop)

    def _switch_off_if_disobeyed(self, records: list[CycleRecord]) -> None:
        """The loop's goal did not reach the drive: by SDO and NMT, once. Beside the rounds: the way to rest and the
        brake take longer than the loop and the watchdog wait for those."""
        if self._switched_off or not any(record.faults & _STAYS_POWERED for record in records):
            return
        self._switched_off = True
        log.error("the drive stays powered: switching it off by SDO and NMT pre-operational")
        self._beside(self._nodes.stop_withdrawn)

    def _beside(self, job: Callable[[], None]) -> None:
        """Run `job` beside the rounds; what it did not expect itself is told, for nobody waits for it."""

        def run_logged() -> None:
            try:
                job()
            except Exception:
                log.exception("stopping the drive by SDO failed in a way that nobody expected")

        asyncio.get_running_loop().run_in_executor(None, run_logged)

    def _notify_manager(self, now_ns: int) -> None:
        """Feed the watchdog only when the loop has gone on since the last time."""
        latest = self._loop.latest
        if self._notifier.watchdog_ns and now_ns >= self._next_feed_ns and latest and latest.cycle != self._fed_cycle:
            self._fed_cycle = latest.cycle
            self._next_feed_ns = now_ns + self._notifier.watchdog_ns // 4
            self._notifier.alive()
        if now_ns >= self._next_status_ns and latest:
            self._next_status_ns = now_ns + _STATUS_NS
            self._keep_lock()
            self._notifier.status(f"{AxisState(latest.axis_state).name}; {self._health.line()}")

    def _keep_lock(self) -> None:
        """What a second daemon would take is ours all the time; one that has it already is told of, once."""
        try:
            self._lock.keep()
        except Unreachable as error:
            if not self._lock_lost:
                log.error("a lock was removed, and is not ours any more: %s", error)
            self._lock_lost = True

    def _write_textfile(self, now_ns: int) -> None:
        if self._config.metrics.textfile is not None and now_ns >= self._next_textfile_ns:
            self._next_textfile_ns = now_ns + _TEXTFILE_NS
            self._verbs.slow.submit(self._metrics_server.write_textfile).add_done_callback(self._textfile_written)

    def _textfile_written(self, future: Future[None]) -> None:
        """Tell of a textfile that cannot be written, once."""
        error = None if future.cancelled() else future.exception()
        if error and not self._textfile_failed:
            log.warning("metrics.textfile %s: %s", self._config.metrics.textfile, error)
        self._textfile_failed = error is not None

    def _loop_is_lost(self) -> bool:
        """It died or hangs. The service manager's SIGTERM reaches both of us: then an orderly end is none."""
        if self._stopping and self._loop.exit_code == 0:
            return False
        return not self._loop.alive() or self._pulse.stopped

    def _lose_loop(self) -> int:
        """The loop died or hangs: the drive brakes before anything else, and is off at rest; then tell, then end for
        systemd to restart. Voltage off at once would let the joint coast."""
        hung = self._loop.alive()
        self._notify_stopping()  # before anything that a silent drive may hold up
        exit_code = self._loop.stop(0.0)  # one that hangs may wake and command again
        self._nodes.stop_axis()
        self._take_records(time.monotonic_ns())
        words = " / ".join(self._loop.last_words().strip().splitlines()[-3:])
        in_order = "it ended in order by itself, told by a signal or since this process stood still"
        detail = "it hung" if hung else f"exit code {exit_code}" if exit_code else in_order
        self._why_ends = f"servod ends, since the loop was lost: {detail}"
        self._faults.raise_own(FaultCode.LOOP_LOST, f"{detail}{': ' + words if words else ''}")
        self._faults.write_file(FaultCode.LOOP_LOST.name)
        return Unreachable.exit_code

    def _stop(self) -> int:
        """Orderly end: the loop brakes, ramps down and disables, the nodes go pre-operational."""
        log.info("stopping: braking, ramping down and disabling")
        timeout_s = self._stop_timeout_s()
        self._notifier.stopping(timeout_s + _STOP_MARGIN_S)
        exit_code = self._loop.stop(timeout_s)
        if exit_code != 0:
            self._notify_stopping()
            self._nodes.stop_axis()
        self._take_records(time.monotonic_ns())
        if exit_code != 0:
            log.error("the loop did not see the drive off (exit code %d); 0x1016 is left as it is", exit_code)
            return Unreachable.exit_code
        self._nodes.stand_down()
        log.info("stopped; the axis is disabled")
        return 0

    def _notify_stopping(self) -> None:
        """To systemd: how long braking by SDO may take, and time-outs of a drive that does not answer."""
        amplifier = self._config.amplifier
        self._notifier.stopping(amplifier.enable_timeout_s + amplifier.brake.engage_s + _STOP_MARGIN_S + _SILENT_S)

    def _leave_for_new(self) -> None:
        """Bus and nodes are back, the drive shows no power. The loop ends, in order where its own connection lives."""
        self._why_ends = "servod begins again, for bus and nodes are back; connect again"
        log.warning(STARTS_AGAIN)
        self._notifier.restarts(STARTS_AGAIN, _RESTART_S)
        self._recorder.add_event("node", "bus and nodes are back: the axis begins again, disabled")
        exit_code = self._loop.stop(_LEAVE_S)
        self._take_records(time.monotonic_ns())
        self._note_node_events()
        latched = self._loop.latest.faults_latched if self._loop.latest else 0
        before = self._comeback.before if self._comeback else 0
        self.carried = carried_by(latched | self._relay.waiting, before)
        if exit_code == 0:
            self._nodes.stand_down()

    def _stop_timeout_s(self) -> float:
        """Braking and ramping, or the drive's quick stop, and then the wait for a drive that shall show it is off."""
        amplifier = self._config.amplifier
        motion_s = 2.0 * self._config.limits.ramp_down_s + amplifier.enable_timeout_s + amplifier.brake.engage_s
        return motion_s + GOODBYE_TIMEOUT_S + _STOP_MARGIN_S

    def _close(self) -> None:
        self._server.close(self._why_ends)
        self._verbs.close()
        self._faults.finish()
        self._recorder.close()
        self._metrics_server.close()
        self._loop.close()

    def _incidents(self) -> dict[str, Any]:
        """What befell the axis since the daemon started, and where the files of earlier times are."""
        directory = str(self._config.recorder.directory.resolve())
        return {"name": self._config.name, "directory": directory, "incidents": self._faults.incidents()}

    def _document(self) -> dict[str, Any]:
        """The status document (servod.runtime.daemon.status.Status)."""
        latest = self._loop.latest
        if latest is None:
            raise Unreachable("the loop has not begun")
        fresh = Freshness.of(self._config, latest, time.monotonic_ns())
        document: Status = {
            "name": self._config.name,
            "version": __version__,
            "uptime_s": time.monotonic() - self._started,
            "axis": axis_status(latest),
            "drive": drive_status(latest, fresh),
            "inputs": inputs_status(self._config.amplifier.inputs, latest),
            "brake": brake_status(self._config.amplifier.brake, latest),
            "motion": motion_status(latest, fresh, self._verbs.abandoned),
            "faults": fault_status(latest),
            "wiring": self._proofs.status(),
            "stopping": None if self._stated_stop is None else self._stated_stop.document(),
            "controller": self._bank.describe(latest.controller),
            "promise": self._promise.status(),
            "loop": {"pid": self._loop.pid, **fresh.record()},
            "timing": self._health.timing(self._loop.lost),
            "bus": bus_status(self._config.bus, self._nodes.plans.bus_load, latest),
            "nodes": self._nodes.status(),
            "guards": self._nodes.guards(),
            "grants": [{"name": g.name, "granted": g.granted, "reason": g.reason} for g in self._loop.grants],
            "recorder": self._recorder.state(),
            "lease": self._server.lease(),
        }
        return dict(document)
