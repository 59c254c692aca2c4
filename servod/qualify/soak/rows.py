"""Checks of the cycle records: every cycle one row, on its time, finite, in a state that belongs to the drive's.

On the recording side of the data path. Batches of rows as numpy sees them; what must hold from batch to batch is kept.
"""

from __future__ import annotations

import functools
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servod.common.faults import FAULTS, FaultCode, faults_in
from servod.common.units import NS_PER_US
from servod.formats.config import AxisConfig, RecorderConfig
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.mcap_writer import split_rows
from servod.formats.recording.record import FIELDS
from servod.lab.recordings.recording import Rows, rows_of
from servod.qualify.soak.starvation import ExcusedFaults
from servod.qualify.soak.tally import Findings, Wrong
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState

Bits = int | NDArray[np.int64]

#: The controller's own numbers, and those that stand for something in the world.
_OWN = (
    "torque_controller_nm",
    "torque_feedback_nm",
    "torque_friction_nm",
    "torque_other_nm",
    "friction_state",
    "disturbance_nm",
)
_REAL = tuple(f.name for f in FIELDS if f.kind == "d" and f.name not in _OWN)
#: Where torque is commanded.
_POWERED = [state for state in AxisState if state.powered]
_OFF = (
    *(DriveState.NOT_READY_TO_SWITCH_ON, DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON),
    *(DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT),
)
#: Where the drive is when the axis has been in a state for longer than it takes the drive to answer.
_SETTLED: dict[AxisState, tuple[DriveState, ...]] = {
    AxisState.DISABLED: _OFF,
    AxisState.ENABLING: (*_OFF, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED),
    **dict.fromkeys(_POWERED, (DriveState.OPERATION_ENABLED,)),
    AxisState.QUICK_STOPPING: (*_OFF, DriveState.QUICK_STOP_ACTIVE),
    AxisState.FAULT: _OFF,
}
_BELONGS = np.zeros((len(AxisState), len(DriveState)), dtype=bool)
for _axis, _drives in _SETTLED.items():
    _BELONGS[_axis, list(_drives)] = True
#: An answer of the drive is seen two SYNCs after the command, and a control word may be lost on the way.
ANSWER_CYCLES = 5
_STAYS_POWERED, _NOT_FINITE = (FAULTS[c].bit for c in (FaultCode.DRIVE_STAYS_POWERED, FaultCode.NOT_FINITE))


class RowCheck:
    """Checks the rows of one axis; `cycles` and `rows` count what the loop numbered and what was recorded."""

    def __init__(self, period_ns: int, torque_limit_nm: float, findings: Findings, tolerance_ns: int = 0) -> None:
        """`tolerance_ns`: how far the middle row of a batch may stand off the clock of the first row; 0: no row at all
        may."""
        self._tolerance_ns = tolerance_ns
        self._period_ns, self._limit_nm, self._findings = period_ns, torque_limit_nm * (1.0 + 1e-9), findings
        self.cycles = self.rows = self.missed = 0
        self.new_session()

    def new_session(self) -> None:
        """The next row is the first of a new loop."""
        self._cycle = self._missed_before = self._astray = 0
        self._origin: tuple[int, int] | None = None  # deadline and number of the session's first cycle

    def check(self, rows: Rows, explained: Bits, answer_cycles: int = ANSWER_CYCLES) -> None:
        """One batch, oldest first. `explained`: the faults that may be seen, in all rows or in each;
        `answer_cycles`: how long drive and axis may be in states that do not belong together."""
        if not len(rows):
            return
        self._numbers(rows)
        self._times(rows)
        self._values(rows)
        self._faults(rows, explained)
        self._states(rows, answer_cycles)

    def _numbers(self, rows: Rows) -> None:
        """Cycle numbers grow by one and by what was missed: a gap is a lost row, a repetition one recorded twice."""
        cycles, missed = rows["cycle"], rows["missed"]
        steps = np.diff(cycles, prepend=self._cycle) - np.diff(missed, prepend=self._missed_before)
        self.rows += len(rows)
        self.cycles += int(cycles[-1]) - self._cycle
        self.missed += int(missed[-1]) - self._missed_before
        lost, double = steps[steps > 1], steps < 1
        if len(lost):
            at = int(np.argmax(steps > 1))
            self._add(Wrong.LOST_ROW, rows, at, f"cycle {cycles[at]} follows a gap", int((lost - 1).sum()))
        if double.any():
            at = int(np.argmax(double))
            self._add(Wrong.DOUBLE_ROW, rows, at, f"cycle {cycles[at]} comes again", int(double.sum()))
        self._missed_before = int(missed[-1])

    def _times(self, rows: Rows) -> None:
        """Cycle k of a session stands at t0 + k * period: its deadline, however late the loop woke."""
        cycles, deadlines = rows["cycle"], rows["time_ns"] - rows["lag_ns"]
        if self._origin is None:
            self._origin = int(deadlines[0]), int(cycles[0])
        off = deadlines - (self._origin[0] + (cycles - self._origin[1]) * self._period_ns)
        if self._tolerance_ns:
            off = np.full(len(rows), np.median(off))
        wrong = np.abs(off) > self._tolerance_ns
        if wrong.any():
            at = int(np.argmax(wrong))
            self._add(Wrong.TIME, rows, at, f"cycle {cycles[at]} is {off[at]:.0f} ns off", int(wrong.sum()))
        self._cycle = int(cycles[-1])

    def _values(self, rows: Rows) -> None:
        """Finite numbers, but for the controller's own while NOT_FINITE is latched; torque only under control."""
        bad, own = (functools.reduce(np.logical_or, [~np.isfinite(rows[n]) for n in names]) for names in (_REAL, _OWN))
        reported = (rows["faults"] | rows["faults_latched"]) & _NOT_FINITE != 0
        self._first(Wrong.NOT_FINITE, rows, bad | (own & ~reported), "a number that is not finite")
        torque_nm = rows["torque_nm"]
        self._first(Wrong.LIMIT, rows, np.abs(torque_nm) > self._limit_nm, "torque above limits.torque_nm")
        uncontrolled = ~np.isin(rows["axis_state"], _POWERED)
        self._first(Wrong.TORQUE, rows, uncontrolled & (torque_nm != 0.0), "torque sent while not controlled")

    def _faults(self, rows: Rows, explained: Bits) -> None:
        """No fault is present or latched that the schedule does not explain."""
        unexplained = (rows["faults"] | rows["faults_latched"]) & ~explained
        seen = int(np.bitwise_or.reduce(unexplained))
        if seen:
            at = int(np.argmax(unexplained != 0))
            names = ", ".join(f.code.name for f in faults_in(seen))
            self._add(Wrong.UNEXPLAINED, rows, at, names)

    def _states(self, rows: Rows, answer_cycles: int) -> None:
        """Fresh words of the drive belong to the axis's state, but for as long as an answer takes."""
        belongs = _BELONGS[rows["axis_state"], rows["drive_state"]]
        astray = ~belongs & (rows["amplifier_age"] == 0) & (rows["faults_latched"] & _STAYS_POWERED == 0)
        lengths = run_lengths(astray, self._astray)
        self._astray = int(lengths[-1])
        too_long = lengths == answer_cycles + 1
        if too_long.any():
            at = int(np.argmax(too_long))
            axis, drive = AxisState(rows["axis_state"][at]).name, DriveState(rows["drive_state"][at]).name
            self._add(Wrong.STATE, rows, at, f"axis {axis}, drive {drive}", int(too_long.sum()))

    def _first(self, wrong: Wrong, rows: Rows, where: NDArray[np.bool_], text: str) -> None:
        if where.any():
            self._add(wrong, rows, int(np.argmax(where)), text, int(where.sum()))

    def _add(self, wrong: Wrong, rows: Rows, at: int, text: str, count: int = 1) -> None:
        self._findings.add(wrong, int(rows["time_ns"][at]), text, count)


def run_lengths(flags: NDArray[np.bool_], before: int) -> NDArray[np.int64]:
    """At each place, how many true flags in a row end there; `before` of them came earlier."""
    positions = np.arange(1, len(flags) + 1)
    last_false = np.maximum.accumulate(np.where(flags, -before, positions))
    return np.where(flags, positions - last_false, 0)


# --- Recorded files --------------------------------------------------------------------------------------------------
# The rows that a daemon recorded, file by file, held against the SYNC frames of the same time. A file that is complete
# is read, checked and removed, so that a soak of days fits a disk.


#: The deadlines of a loop on the wall clock may seem so far off, by what a wake-up costs beyond its lag.
_TOLERANCE_NS = 2_000_000
#: How long, in cycles, drive and axis may disagree where processes wait for their turn.
_ANSWER_CYCLES = 100


class RecordedRows:
    """Checks all recordings of one axis; `files` counts them, `check` holds the counts of rows and cycles."""

    def __init__(self, config: AxisConfig, findings: Findings) -> None:
        period_ns = config.cycle.period_us * NS_PER_US
        self._folder, self._findings = config.recorder.directory, findings
        self.check = RowCheck(period_ns, config.limits.torque_nm, findings, _TOLERANCE_NS)
        self.files = self.syncs = self.syncs_taken = 0
        self._rows_of_session = self._latched = 0
        self.excused: Counter[str] = Counter()

    def take(self, schedule: ExcusedFaults, starvation: ExcusedFaults, ended: bool) -> None:
        """Check every complete file; with `ended` the daemon is gone and all are.

        A fault has its cause in the schedule, or in a machine that starved the processes at that time; the second are
        counted in `excused`. What is latched stays so, and is judged once.
        """
        paths = [path for path in self._folder.glob("*.mcap") if "-fault-" not in path.name]
        paths.sort(key=lambda path: path.stat().st_mtime_ns)
        for path in paths if ended else paths[:-1]:
            recording = read_recording(path)
            if recording.truncated:
                self._findings.add(Wrong.RECORDER, None, f"{path.name} has no end")
            rows = rows_of(recording.rows)
            self.check.check(rows, self._allowed(rows, schedule, starvation), _ANSWER_CYCLES)
            self._rows_of_session += len(recording)
            self.files += 1
            path.unlink()

    def _allowed(self, rows: Rows, schedule: ExcusedFaults, starvation: ExcusedFaults) -> NDArray[np.int64]:
        """The fault bits that each row may have; counts those that only a starved machine explains."""
        latched = rows["faults_latched"]
        before = np.concatenate(([self._latched], latched[:-1]))[: len(latched)]
        strict = schedule.at(rows["time_ns"])
        allowed = strict | starvation.at(rows["time_ns"])
        for bits in (latched & ~before & allowed & ~strict).tolist():
            self.excused.update(fault.code.name for fault in faults_in(bits))
        self._latched = int(latched[-1]) if len(latched) else self._latched
        return allowed | before

    def end_session(self, heard: int, may_be_taken: bool) -> None:
        """The daemon ended: the SYNC frames that were `heard` while it ran are as many as its rows."""
        rows, self._rows_of_session, self._latched = self._rows_of_session, 0, 0
        self.syncs += heard
        if may_be_taken and heard < rows:
            self.syncs_taken += rows - heard
        elif heard != rows:
            self._findings.add(Wrong.SYNC, None, f"{heard} SYNC frames on the bus, {rows} rows recorded")
        self.check.new_session()


# --- What the recorder keeps -----------------------------------------------------------------------------------------
# Whether the recorder keeps every row: what it wrote is read back and held against what it was given, byte by byte. The
# same recorder as the daemon's.


class RecordingCheck:
    """Recordings of single episodes in `folder`, each removed once it was found whole; `rows` counts what was."""

    def __init__(self, config: AxisConfig, folder: Path, findings: Findings) -> None:
        recorder = RecorderConfig(directory=folder, history_s=1.0)
        self._recorder, self._findings = Recorder(recorder, "soak", config.cycle.period_us), findings
        self._given: bytearray | None = None
        self._path = Path()
        self.recordings = self.rows = 0

    def start(self) -> None:
        """Record from now on."""
        self._path = self._recorder.start().result()
        self._given = bytearray()

    def add(self, raw: bytes) -> None:
        """Rows of the loop, when something is being recorded."""
        if self._given is not None:
            self._given += raw
            self._recorder.add_rows(list(split_rows(raw)))

    def stop(self, time_ns: int) -> None:
        """End the recording, if there is one, and compare."""
        given, self._given = self._given, None
        if given is None:
            return
        state = self._recorder.stop().result()
        found = read_recording(self._path)
        if found.rows == given and not found.truncated and not state["failure"]:
            self._path.unlink()
            self.recordings += 1
            self.rows += len(found)
            return
        text = f"{self._path}: {len(found)} rows, {state['dropped']} dropped. {state['failure']}"
        self._findings.add(Wrong.RECORDER, time_ns, text)

    def close(self) -> None:
        """End the recorder."""
        self._recorder.close()
