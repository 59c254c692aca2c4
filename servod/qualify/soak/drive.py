"""Checks of the drive's own record: torque only where a drive may have it, and how soon it was gone after a fault.

Behind the virtual drive, which writes the record by itself; nothing here comes from the loop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.drivers.virtual.drive_record import SAMPLE, DriveSample
from servod.lab.recordings.recording import Rows
from servod.qualify.faults.judge import ReactionTimes, reaction
from servod.qualify.faults.stops import NO_TORQUE_NM
from servod.qualify.soak.kinds import InjectionKind
from servod.qualify.soak.tally import FaultTally, Findings, Wrong
from servod.runtime.fieldbus.devices import DriveState

Samples = NDArray[np.void]

_CODES = {"q": "<i8", "H": "<u2", "h": "<i2", "d": "<f8"}
SAMPLE_ROW = np.dtype(
    [(name, _CODES[code]) for name, code in zip(DriveSample._fields, SAMPLE.format.lstrip("<"), strict=True)]
)
_POWERED = [state for state in DriveState if state.powered]


def samples_of(raw: bytes) -> Samples:
    """Packed samples of the drive's record."""
    return np.frombuffer(raw, dtype=SAMPLE_ROW)


def reaction_in(samples: Samples, injected_ns: int) -> ReactionTimes:
    """What the drive did after `injected_ns`, as the fault campaign judges it."""
    after = samples[samples["time_ns"] >= injected_ns].tolist()
    return reaction([DriveSample(time_ns, DriveState(state), *rest) for time_ns, state, *rest in after], injected_ns)


class DriveCheck:
    """Checks the samples of one drive; `samples` counts them."""

    def __init__(self, torque_limit_nm: float, findings: Findings, order_ns: int = 0) -> None:
        """`order_ns`: how far samples may stand out of order, where timers and frames are served on the wall clock."""
        self._order_ns = order_ns
        self._limit_nm, self._findings = torque_limit_nm * (1.0 + 1e-9), findings
        self.samples = 0
        self._time_ns = self._lost = 0

    def check(self, samples: Samples, lost: int) -> None:
        """One batch; `lost` samples so far were overwritten unread."""
        self.samples += len(samples)
        if lost > self._lost:
            self._findings.add(Wrong.RECORDER, self._time_ns, f"{lost} samples of the drive's record were not read")
            self._lost = lost
        if not len(samples):
            return
        times_ns, torque_nm = samples["time_ns"], np.abs(samples["torque_nm"])
        back = np.diff(times_ns, prepend=max(self._time_ns, int(times_ns[0]) - self._order_ns)) < -self._order_ns
        self._first(Wrong.TIME, samples, back, "the drive's record goes back in time")
        energised = np.isin(samples["state"], _POWERED)
        self._first(Wrong.TORQUE, samples, ~energised & (torque_nm > NO_TORQUE_NM), "torque in a drive that is off")
        self._first(Wrong.LIMIT, samples, torque_nm > self._limit_nm, "torque above the drive's maximum")
        finite = np.isfinite(samples["position_rad"]) & np.isfinite(samples["velocity_rad_s"])
        self._first(Wrong.NOT_FINITE, samples, ~finite, "the joint's motion is not finite")
        self._time_ns = int(times_ns[-1])

    def _first(self, wrong: Wrong, samples: Samples, where: NDArray[np.bool_], text: str) -> None:
        if where.any():
            self._findings.add(wrong, int(samples["time_ns"][int(np.argmax(where))]), text, int(where.sum()))


# --- The reaction ----------------------------------------------------------------------------------------------------
# Whether a fault was seen and the drive reacted in time, by its own record: out of the command, and without torque. The
# bounds are those of the fault's kind.


def check_trace(kind: InjectionKind, happened: bool, injected_ns: int, findings: Findings) -> None:
    """Find a fault that was injected and did not happen: that an axis rides through nothing tells nothing."""
    if not happened:
        findings.add(Wrong.NO_TRACE, injected_ns, f"{kind.name}: nothing of it was on the bus")


def check_reaction(
    kind: InjectionKind,
    times: ReactionTimes,
    injected_ns: int,
    tally: FaultTally,
    findings: Findings,
    grace_ms: float = 0.0,
    waited_ms: float = 0.0,
) -> bool:
    """Count both times, and find what was too late. `grace_ms`: what belongs to each bound besides that of the kind;
    `waited_ms`: how long the processes had to wait for their turn.

    Returns whether a time was late, but no later than that wait excuses.
    """
    excused = False
    for what, time_ms, limit_ms, seen in (
        ("command left", times.left_ms, kind.left_ms + grace_ms, tally.left),
        ("torque gone", times.gone_ms, kind.gone_ms + grace_ms, tally.gone),
    ):
        if time_ms is not None:
            seen.add(time_ms)
        if time_ms is None or time_ms > limit_ms + waited_ms:
            when = "never" if time_ms is None else f"after {time_ms:.0f} ms"
            findings.add(Wrong.LATE, injected_ns, f"{kind.name}: {what} {when}, {limit_ms:g} ms allowed")
        elif time_ms > limit_ms:
            excused = True
    return excused


def detected_after_ms(rows: Rows, injected_ns: int, expected: int) -> float | None:
    """From the injection to the first row in which one of the `expected` bits is latched; None when there is none."""
    found = np.flatnonzero((rows["faults_latched"] & expected != 0) & (rows["time_ns"] >= injected_ns))
    return float(rows["time_ns"][found[0]] - injected_ns) / 1e6 if len(found) else None
