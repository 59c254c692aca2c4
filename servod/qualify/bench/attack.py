"""The loop's wake-up and a stop, while the control socket is under attack, against the same run without.

Daemon, virtual axis and attackers are processes of their own. That the axis has stopped is what the virtual drive's own
record says. A machine that is shared has outliers of its own: each round has a part without an attack, which its part
with one is held against, and the round with the least of the machine in it is the one that tells of the daemon.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from servod.client.control import ControlClient
from servod.client.processes import RunningAxis, child, running_axis, sigterm_as_interrupt, socket_folder, wait_until
from servod.common.errors import AnswerIsNo
from servod.drivers.virtual.drive_record import read_drive_record
from servod.formats.recording.mcap_reader import read_recording
from servod.qualify.bench.attackers import AT_WORK, AttackTally, failed
from servod.qualify.bench.wall_clock import resident_kib
from servod.qualify.demo.axis import demo_config, plant_file
from servod.runtime.fieldbus.devices import DriveState

_GATHER_S = 30.0  # at most, until every attack is under way
_KIB_PER_MIB = 1024.0
_NS_PER_MS = 1e6
_BYTES_PER_MB = 1e6


@dataclass(frozen=True)
class _Span:
    """Cycles of one part of the run."""

    first: int
    last: int


@dataclass(frozen=True)
class _Round:
    """One part without an attack and one with it: cycles, and times to stop in ms."""

    quiet: _Span
    attacked: _Span
    quiet_stop_ms: list[float]
    stop_ms: list[float]
    growth_mib: float
    tallies: dict[str, AttackTally]


def measure(quiet_s: float, attack_s: float, stops: int, rounds: int) -> dict[str, Any]:
    """Wake-up and times to stop in ms before and during the attack, round by round; growth of the daemon in MiB.

    Raises AnswerIsNo when a kind of attack did not take place, or the axis did not get through; Unreachable when a
    process or the attack does not begin.
    """
    with sigterm_as_interrupt(), socket_folder("servod-attack-") as name:
        folder = Path(name)
        config, record = demo_config(folder, folder / "recordings"), folder / "drive.bin"
        with running_axis(config, plant_file(None), folder, ["--record", str(record)]) as axis:
            path = axis.client.call("record_start")["path"]
            done = [_round(axis, record, folder / "attackers.log", quiet_s, attack_s, stops) for _ in range(rounds)]
            axis.client.call("record_stop")
            return _document(path, done)


def _round(axis: RunningAxis, record: Path, log: Path, quiet_s: float, attack_s: float, stops: int) -> _Round:
    client, daemon_pid = axis
    quiet = _watch(client, quiet_s)
    quiet_ms = [_stop(client, record) for _ in range(stops)]
    before_kib = resident_kib(daemon_pid)
    seconds = str(_GATHER_S + attack_s + 60.0)
    with child("servod.qualify.bench.attackers", [client.path, seconds], log) as attackers:
        wait_until(lambda: AT_WORK in log.read_text(encoding="utf-8", errors="replace"), attackers, log, _GATHER_S)
        attacked = _watch(client, attack_s)
        times_ms = [_stop(client, record) for _ in range(stops)]
        if attackers.poll() is not None:
            raise AnswerIsNo(f"the attackers ended before the attack: {log.read_text(encoding='utf-8')[-500:]}")
        growth_mib = (resident_kib(daemon_pid) - before_kib) / _KIB_PER_MIB
    return _Round(quiet, attacked, quiet_ms, times_ms, growth_mib, read_tallies(log))


def read_tallies(log: Path) -> dict[str, AttackTally]:
    """What each kind of attack did, from what the attackers said at their end.

    Raises AnswerIsNo when they said nothing, or when an attack did not take place.
    """
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    if not lines or not lines[-1].startswith("{"):
        raise AnswerIsNo(f"the attackers did not tell what they did: {' '.join(lines)[-500:]}")
    tallies = {name: AttackTally(**did) for name, did in json.loads(lines[-1]).items()}
    if missing := failed(tallies):
        raise AnswerIsNo(f"no attack of these kinds took place: {', '.join(missing)}")
    return tallies


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
    client.call("track", kind="sine", amplitude_rad=0.05, frequency_hz=1.0, duration_s=600.0, renew_s=None)


def _stop(client: ControlClient, record: Path) -> float:
    """Milliseconds from a newcomer's wish to stop until the drive is off and without torque for good."""
    _move(client)
    time.sleep(0.3)
    asked_ns = time.monotonic_ns()
    with ControlClient(client.path) as newcomer:
        newcomer.call("stop")
    acting = [s.time_ns for s in read_drive_record(record) if s.state == DriveState.OPERATION_ENABLED or s.torque_nm]
    return (max(acting) - asked_ns) / _NS_PER_MS


def _document(path: str, rounds: Sequence[_Round]) -> dict[str, Any]:
    recording = read_recording(path)
    cycles, lags_ns = recording.column("cycle"), recording.column("lag_ns")
    rows = list(zip(cycles, lags_ns, strict=True))
    return {
        "rounds": [_figures(rows, one) for one in rounds],
        "growth_mib": sum(one.growth_mib for one in rounds),
        "attacks": _attacks(rounds),
    }


def _figures(rows: Sequence[tuple[float, float]], one: _Round) -> dict[str, Any]:
    """One round; its ratios are of the part under attack to the part without, of the same seconds of the machine."""
    quiet, attacked = _lag(rows, one.quiet), _lag(rows, one.attacked)
    return {
        "quiet": quiet,
        "attacked": attacked,
        "median_ratio": attacked["median_us"] / max(quiet["median_us"], 1.0),
        "p99_ratio": attacked["p99_us"] / max(quiet["p99_us"], 1.0),
        "more_late_share": attacked["late_share"] - quiet["late_share"],
        "quiet_stop_ms": one.quiet_stop_ms,
        "stop_ms": one.stop_ms,
    }


def _attacks(rounds: Sequence[_Round]) -> dict[str, dict[str, int]]:
    """Connections and bytes of each kind, of all rounds."""
    return {
        name: {
            "connections": sum(one.tallies[name].connections for one in rounds),
            "bytes": sum(one.tallies[name].bytes for one in rounds),
        }
        for name in rounds[0].tallies
    }


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
    """The figures as people read them: of each round, then of all."""
    lines = [line for number, one in enumerate(document["rounds"], 1) for line in _round_text(number, one)]
    lines.append(f"daemon's memory:  {document['growth_mib']:+.1f} MiB")
    attacks = document["attacks"].items()
    lines.append("attacks, connections and MB sent: " + ", ".join(
        f"{name} {did['connections']} / {did['bytes'] / _BYTES_PER_MB:.1f}" for name, did in attacks
    ))  # fmt: skip
    return "\n".join(lines)


def _round_text(number: int, one: dict[str, Any]) -> list[str]:
    quiet, attacked, stops, alone = one["quiet"], one["attacked"], one["stop_ms"], one["quiet_stop_ms"]
    return [
        f"round {number}",
        f"wake-up, median:  {quiet['median_us']:.1f} µs alone, {attacked['median_us']:.1f} µs under attack "
        f"({one['median_ratio']:.2f}×)",
        f"wake-up, p99:     {quiet['p99_us']:.0f} µs alone, {attacked['p99_us']:.0f} µs under attack "
        f"({one['p99_ratio']:.2f}×)",
        f"skipped cycles:   {quiet['late_share']:.3%} alone, {attacked['late_share']:.3%} under attack",
        f"time to stop:     median {statistics.median(stops):.0f} ms, longest {max(stops):.0f} ms of {len(stops)} "
        f"(alone: {statistics.median(alone):.0f} ms, {max(alone):.0f} ms)",
    ]
