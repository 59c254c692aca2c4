"""Whether a fault was seen and the drive reacted in time, by its own record: out of the command, and without torque.

Between rows, the drive's record and the findings; the bounds are those of the fault's kind.
"""

from __future__ import annotations

import numpy as np

from servod.qualify.faults.judge import Reaction
from servod.qualify.soak.finding import Findings, Wrong
from servod.qualify.soak.kinds import FaultKind
from servod.qualify.soak.rows import Rows
from servod.qualify.soak.tally import FaultTally


def check_trace(kind: FaultKind, happened: bool, injected_ns: int, findings: Findings) -> None:
    """Find a fault that was injected and did not happen: that an axis rides through nothing tells nothing."""
    if not happened:
        findings.add(Wrong.NO_TRACE, injected_ns, f"{kind.name}: nothing of it was on the bus")


def check_reaction(
    kind: FaultKind,
    times: Reaction,
    injected_ns: int,
    tally: FaultTally,
    findings: Findings,
    grace_ms: float = 0.0,
    starved_ms: float = 0.0,
) -> bool:
    """Count both times, and find what was too late. `grace_ms`: what belongs to each bound besides that of the kind;
    `starved_ms`: how long the processes had to wait for their turn.

    Returns whether a time was late, but no later than that wait excuses.
    """
    excused = False
    for what, time_ms, limit_ms, seen in (
        ("command left", times.left_ms, kind.left_ms + grace_ms, tally.left),
        ("torque gone", times.gone_ms, kind.gone_ms + grace_ms, tally.gone),
    ):
        if time_ms is not None:
            seen.add(time_ms)
        if time_ms is None or time_ms > limit_ms + starved_ms:
            told = "never" if time_ms is None else f"after {time_ms:.0f} ms"
            findings.add(Wrong.LATE, injected_ns, f"{kind.name}: {what} {told}, {limit_ms:g} ms allowed")
        elif time_ms > limit_ms:
            excused = True
    return excused


def detected_after_ms(rows: Rows, injected_ns: int, expected: int) -> float | None:
    """From the injection to the first row in which one of the `expected` bits is latched; None when there is none."""
    found = np.flatnonzero((rows["faults_latched"] & expected != 0) & (rows["time_ns"] >= injected_ns))
    return float(rows["time_ns"][found[0]] - injected_ns) / 1e6 if len(found) else None
