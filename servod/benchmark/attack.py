"""The loop's wake-up and a stop, while the control socket is under attack, against the same run without.

Daemon, virtual axis and attackers are processes of their own. That the axis has stopped is what the virtual drive's own
record says; the figures are medians and shares, because a machine that is shared has outliers of its own.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from servod.benchmark.wall import resident_kib
from servod.control import ControlClient
from servod.demo.axis import demo_config, plant_file
from servod.demo.processes import child, sigterm_as_interrupt
from servod.demo.wall import running_axis
from servod.drivers.virtual.drive_record import read_drive_record
from servod.errors import AnswerIsNo
from servod.hal import DriveState
from servod.recorder_read import read_recording

_GATHER_S = 1.0  # until every attacker is at work
_KIB_PER_MIB = 1024.0
_NS_PER_MS = 1e6


@dataclass(frozen=True)
class _Span:
    """Cycles of one part of the run."""

    first: int
    last: int


def measure(quiet_s: float, attack_s: float, stops: int) -> dict[str, Any]:
    """Wake-up before and during the attack, times to stop in ms, and growth of the daemon's memory in MiB."""
    with sigterm_as_interrupt(), tempfile.TemporaryDirectory(prefix="servod-attack-") as name:
        folder = Path(name)
        config, record = demo_config(folder, folder / "recordings"), folder / "drive.bin"
        with running_axis(config, plant_file(None), folder, ["--record", str(record)]) as (client, daemon_pid):
            path = client.call("record_start")["path"]
            quiet = _watch(client, quiet_s)
            quiet_ms = [_stop(client, record) for _ in range(stops)]
            before_kib = resident_kib(daemon_pid)
            seconds = str(_GATHER_S + attack_s + 60.0)
            log = folder / "attackers.log"
            with child("servod.benchmark.attackers", [client.path, seconds], log) as attackers:
                time.sleep(_GATHER_S)
                attacked = _watch(client, attack_s)
                times_ms = [_stop(client, record) for _ in range(stops)]
                if attackers.poll() is not None:
                    raise AnswerIsNo(f"the attackers ended before the attack: {log.read_text()[-500:]}")
                growth_mib = (resident_kib(daemon_pid) - before_kib) / _KIB_PER_MIB
            client.call("record_stop")
            return _figures(path, quiet, attacked) | {
                "quiet_stop_ms": quiet_ms,
                "stop_ms": times_ms,
                "growth_mib": growth_mib,
            }


def _watch(client: ControlClient, duration_s: float) -> _Span:
    """Move for `duration_s`; the cycles from begin to end. Raises AnswerIsNo when the axis does not get through."""
    _move(client)
    first = client.call("status")["timing"]["cycle"]
    time.sleep(duration_s)
    status = client.call("status")
    client.call("disable")
    if status["axis"]["state"] != "ENABLED":
        raise AnswerIsNo(f"the axis went to {status['axis']['state']} while it was to move")
    return _Span(first, status["timing"]["cycle"])


def _move(client: ControlClient) -> None:
    client.call("enable", reset_fault=True)
    client.call("track", kind="sine", amplitude_rad=0.05, frequency_hz=1.0, duration_s=600.0)


def _stop(client: ControlClient, record: Path) -> float:
    """Milliseconds from a newcomer's wish to stop until the drive is off and without torque for good."""
    _move(client)
    time.sleep(0.3)
    asked_ns = time.monotonic_ns()
    with ControlClient(client.path) as newcomer:
        newcomer.call("stop")
    acting = [s.time_ns for s in read_drive_record(record) if s.state == DriveState.OPERATION_ENABLED or s.torque_nm]
    return (max(acting) - asked_ns) / _NS_PER_MS


def _figures(path: str, quiet: _Span, attacked: _Span) -> dict[str, Any]:
    recording = read_recording(path)
    cycles, lags_ns = recording.column("cycle"), recording.column("lag_ns")
    rows = list(zip(cycles, lags_ns, strict=True))
    figures: dict[str, Any] = {"quiet": _lag(rows, quiet), "attacked": _lag(rows, attacked)}
    calm = max(figures["quiet"]["median_us"], 1.0)
    return figures | {"median_ratio": figures["attacked"]["median_us"] / calm}


def _lag(rows: Sequence[tuple[float, float]], span: _Span) -> dict[str, float]:
    lags_us = [lag_ns / 1e3 for cycle, lag_ns in rows if span.first <= cycle <= span.last]
    return {
        "median_us": statistics.median(lags_us),
        "p99_us": _percentile(lags_us, 0.99),
        "late_share": 1.0 - len(lags_us) / (span.last - span.first + 1),
    }


def _percentile(values: Sequence[float], share: float) -> float:
    return sorted(values)[int(share * (len(values) - 1))]


def text(document: dict[str, Any]) -> str:
    """The figures as people read them."""
    quiet, attacked, stops = document["quiet"], document["attacked"], document["stop_ms"]
    alone = document["quiet_stop_ms"]
    return "\n".join([
        f"wake-up, median:  {quiet['median_us']:.1f} µs alone, {attacked['median_us']:.1f} µs under attack "
        f"({document['median_ratio']:.2f}×)",
        f"wake-up, p99:     {quiet['p99_us']:.0f} µs alone, {attacked['p99_us']:.0f} µs under attack",
        f"skipped cycles:   {quiet['late_share']:.3%} alone, {attacked['late_share']:.3%} under attack",
        f"time to stop:     median {statistics.median(stops):.0f} ms, longest {max(stops):.0f} ms of {len(stops)} "
        f"(alone: {statistics.median(alone):.0f} ms, {max(alone):.0f} ms)",
        f"daemon's memory:  {document['growth_mib']:+.1f} MiB",
    ])  # fmt: skip
