"""Whether the drive's record can be judged at all, and what the joint did of an axis that stayed enabled.

Part of the judge. Nothing here comes from the loop: where the joint should be is what it did before the injection,
continued.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from servod.common.errors import AnswerIsNo, BadInput
from servod.drivers.virtual.drive_record import DriveSample
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.record import CycleRecord
from servod.qualify.faults.scenario import Runs, Scenario, ScenarioStart
from servod.qualify.faults.under_test import MOTION
from servod.runtime.fieldbus.devices import DriveState

#: The drive's record is written every 2 ms by its own watch; on the wall clock its process gets the core when others
#: let it, and in the guest the service manager may have to start it again. So late may it end [ms].
_REACHES_MS = {Runs.STEPPED: 5.0, Runs.PROCESSES: 250.0, Runs.GUEST: 5000.0}
#: What is injected at a moment may stand in the record with the time of the device's last event before it.
_SAME_NS = 2_000_000
#: A joint that moves against friction feels this torque at least, once in this time before the injection.
_MOVING_NM, _JUST_BEFORE_NS = 0.01, 250_000_000
#: The motion has begun when the joint is so far from where it was enabled [rad].
_BEGUN_RAD = 0.002
_NS_PER_S, _NS_PER_MS = 1e9, 1e6


class Watch(NamedTuple):
    """The time that is judged: from the first injection to the end of the watch, on the clock of the drive's record."""

    injected_ns: int
    ended_ns: int


def check_strays(scenario: Scenario, where: str) -> None:
    """Raises BadInput for a bound that a joint which stops dead would keep: that one strays by its whole amplitude."""
    half_rad = MOTION[scenario.runs].amplitude_rad / 2
    expected = scenario.expect
    if expected.stays_enabled and scenario.start is ScenarioStart.MOVING and expected.strays_rad > half_rad:
        allowed = f"at most {half_rad:g}, half the amplitude of its motion on {scenario.runs}"
        raise BadInput(f"{where}: expect.strays_rad", expected.strays_rad, allowed)


def record_complaints(scenario: Scenario, samples: Sequence[DriveSample], watch: Watch) -> Iterator[str]:
    """What is missing in the record; a scenario that starts off has nothing to show before its bring-up."""
    if scenario.start is ScenarioStart.OFF:
        return
    before = [s for s in samples if s.time_ns < watch.injected_ns]
    if not before:
        yield "the drive's record does not begin before the injection"
    elif not any(s.time_ns > watch.injected_ns for s in samples):
        yield "the drive's record ends at the injection"
    elif (short_ms := (watch.ended_ns - samples[-1].time_ns) / _NS_PER_MS) > _REACHES_MS[scenario.runs]:
        yield f"the drive's record ends {short_ms:.0f} ms before the end of the watch"
    settled = [s.state for s in before if s.time_ns < watch.injected_ns - _SAME_NS]
    if settled and scenario.start.powered and settled[-1] is not DriveState.OPERATION_ENABLED:
        yield f"the drive was in {settled[-1].name} at the injection, not in operation enabled"
    if scenario.start in (ScenarioStart.MOVING, ScenarioStart.PROVING) and not _felt(before, watch):
        yield "the joint felt no torque before the injection: a time until it is gone tells nothing"


def motion_complaints(scenario: Scenario, samples: Sequence[DriveSample], watch: Watch) -> Iterator[str]:
    """What an axis that should go on did otherwise: by itself, an ENABLED at the end says little."""
    expected = scenario.expect
    after = [s for s in samples if s.time_ns > watch.injected_ns]
    if not expected.stays_enabled or not scenario.start.powered or not after:
        return
    for state in sorted({s.state.name for s in after} - {DriveState.OPERATION_ENABLED.name}):
        yield f"the drive went to {state} on the way"
    if not all(math.isfinite(s.position_rad) and math.isfinite(s.velocity_rad_s) for s in samples):
        yield "the joint's motion is not finite"
        return
    strays_rad = _strays_rad(scenario, samples, watch.injected_ns)
    if not strays_rad <= expected.strays_rad:
        yield f"the joint was {strays_rad:.3f} rad from its motion, expected {expected.strays_rad:g} rad"
    fastest_rad_s = max(abs(s.velocity_rad_s) for s in after)
    if fastest_rad_s > expected.fastest_rad_s:
        yield f"the joint turned at {fastest_rad_s:.1f} rad/s, expected {expected.fastest_rad_s:g} rad/s"


def _felt(before: Sequence[DriveSample], watch: Watch) -> bool:
    since_ns = watch.injected_ns - _JUST_BEFORE_NS
    return any(abs(s.torque_nm) >= _MOVING_NM for s in before if s.time_ns >= since_ns)


def _strays_rad(scenario: Scenario, samples: Sequence[DriveSample], injected_ns: int) -> float:
    """Furthest distance after the injection from the motion of before, continued; NaN where there was none."""
    rows = [((s.time_ns - injected_ns) / _NS_PER_S, s.position_rad) for s in samples]
    before = [pair for pair in zip(rows, samples, strict=True) if pair[0][0] < 0]
    # The drive's record may go on from axis to axis: where it was enabled last, counts.
    enabled_last = takewhile(lambda pair: pair[1].state is DriveState.OPERATION_ENABLED, reversed(before))
    held = [row for row, _ in enabled_last][::-1]
    if not held:
        return math.nan
    center_rad, omega, sine, cosine = held[-1][1], 0.0, 0.0, 0.0
    if scenario.start is ScenarioStart.MOVING:
        center_rad, omega = held[0][1], 2.0 * math.pi * MOTION[scenario.runs].frequency_hz
        sine, cosine = _fitted(held, center_rad, omega)
    return max(
        abs(x - center_rad - sine * math.sin(omega * t) - cosine * math.cos(omega * t)) for t, x in rows if t > 0.0
    )


def _fitted(held: Sequence[tuple[float, float]], center_rad: float, omega: float) -> tuple[float, float]:
    """Sine and cosine part of the joint's motion about where it was enabled, by least squares.

    The first third of it is left out: friction lets the joint follow only by and by.
    """
    first = next((n for n, (_, x) in enumerate(held) if abs(x - center_rad) > _BEGUN_RAD), len(held))
    used = held[first + (len(held) - first) // 3 :]
    ss = sc = cc = sx = cx = 0.0
    for time_s, position_rad in used:
        s, c, x = math.sin(omega * time_s), math.cos(omega * time_s), position_rad - center_rad
        ss, sc, cc, sx, cx = ss + s * s, sc + s * c, cc + c * c, sx + s * x, cx + c * x
    determinant = ss * cc - sc * sc
    if determinant <= 0.0:
        return math.nan, math.nan
    return (sx * cc - cx * sc) / determinant, (cx * ss - sx * sc) / determinant


# --- Lost records ----------------------------------------------------------------------------------------------------
# How many cycle records a scenario cost: what is missing in the recordings that the daemon left. Behind the recorder of
# a daemon that always records. A recording that cannot be read at all is a complaint of its own (BadInput), and so is
# none (AnswerIsNo): 0 records are lost only where there were records.


#: A row is in the file when its chunk is, after half a second; the rest is for a machine that others use too [s].
_REACHES_S, _POLL_S = 2.0, 0.1


def lost_records(folder: Path, period_ns: int, due_ns: int | None) -> int:
    """Cycles without a row in the recordings of `folder`; the files of single faults are not counted.

    Cycles that the loop skipped are none. Up to `due_ns` there must be rows: now, or when the daemon was hit; None
    where it ended by itself. Raises BadInput for a recording that cannot be read, AnswerIsNo when there is none.
    """
    runs = [rows for path in _recordings(folder) if (rows := read_recording(path).records())]
    if not runs:
        raise AnswerIsNo(f"{folder}: no cycle was recorded, though recorder.always is set")
    tail_ns = 0 if due_ns is None else max(0, due_ns - max(rows[-1].time_ns for rows in runs))
    return sum(_holes(rows) for rows in runs) + tail_ns // period_ns


def wait_for_rows(folder: Path, until_ns: int, timeout_s: float = _REACHES_S) -> None:
    """Give a recorder that runs the time to bring the row of `until_ns` into its file; one that stopped never does."""
    deadline_s = time.monotonic() + timeout_s
    while _last_ns(folder) < until_ns and time.monotonic() < deadline_s:
        time.sleep(_POLL_S)


def _recordings(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.glob("*.mcap")) if "-fault-" not in path.name)


def _last_ns(folder: Path) -> int:
    """Time of the last row in the newest recording; 0 without one, or as long as there is no row in it."""
    newest = max(_recordings(folder), key=lambda path: path.stat().st_mtime_ns, default=None)
    with contextlib.suppress(BadInput):
        rows = read_recording(newest).records() if newest is not None else []
        return rows[-1].time_ns if rows else 0
    return 0


def _holes(rows: list[CycleRecord]) -> int:
    """Cycle numbers between the first row and the last that neither stand there nor were skipped by the loop."""
    return rows[-1].cycle - rows[0].cycle + 1 - len(rows) - (rows[-1].missed - rows[0].missed)
