"""The document of a soak, as JSON has it: of one run, and of several added up.

Behind the run; `page` shows it. A soak passed when nothing was found wrong and nothing is `unproven`: it came to the
end that was ordered, every job of it ended well, and every memory that was watched for long enough is flat. A memory
that was watched too shortly to tell stands in `untold`, and the verdict says so.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any

from servod.qualify.soak.counts import SoakedAxis
from servod.qualify.soak.memory import LIMIT_KB_PER_H, LONG_S, Growth, Memory
from servod.qualify.soak.tally import COUNTED, median_ms

_CURVE_POINTS = 200
_NS_PER_H = 3.6e12
#: Exit codes with which `servoctl soak` says what it found; None: still running.
_SAID = (0, 1, None)
_ADDED = (
    *("cycles", "rows", "missed", "syncs", "syncs_taken", "drive_samples", "recordings", "rows_read_back", "episodes"),
    *("cpu_s", "restarts", "axis_hours", "faults_injected", "faults_while_proving", "faults_due", "faults_found"),
    *("faults_ridden_through", "faults_spoilt_proof", "faults_recovered"),
)


class Course(StrEnum):
    """How far a soak has come."""

    RUNNING = "still running"
    COMPLETE = "complete"
    INTERRUPTED = "interrupted"
    CUT_SHORT = "ended short of its order"


def document(axis: SoakedAxis, memories: Mapping[str, Memory], wall_s: float, course: Course) -> dict[str, Any]:
    """Everything of one run."""
    counts, tally, findings = axis.counts, axis.tally, axis.findings
    faults, unproven = tally.faults.values(), _unproven(memories, course)
    return {
        "passed": not findings.counts and not unproven,
        "unproven": unproven,
        "untold": [name for name, memory in memories.items() if memory.slope().growth is Growth.TOO_SHORT],
        "running": course is Course.RUNNING,
        "interrupted": course is Course.INTERRUPTED,
        "wall_s": round(wall_s, 1),
        "cpu_s": round(time.process_time(), 1),
        "axis_hours": counts.cycles * counts.period_ns / _NS_PER_H,
        **{name: value for name, value in counts._asdict().items() if name != "period_ns"},
        "episodes": tally.episodes,
        "restarts": tally.restarts,
        "faults_injected": sum(f.injected for f in faults),
        "faults_while_proving": sum(f.proving for f in faults),
        "faults_due": sum(f.due for f in faults),
        "faults_found": sum(f.found for f in faults),
        "faults_ridden_through": sum(f.ridden for f in faults),
        "faults_spoilt_proof": sum(f.spoilt for f in faults),
        "faults_recovered": sum(f.recovered for f in faults),
        "wrong": {str(kind): count for kind, count in findings.counts.items()},
        "findings": [{**f._asdict(), "wrong": str(f.wrong)} for f in findings.told],
        "faults": {name: fault.document() for name, fault in sorted(tally.faults.items())},
        "moves": dict(tally.moves),
        "endings": dict(tally.endings),
        "gain_sets": dict(tally.laws),
        "excused": dict(tally.excused),
        "memory": [memory_document(name, memory) for name, memory in memories.items()],
    }


def _unproven(memories: Mapping[str, Memory], course: Course) -> list[str]:
    """Why a run in which nothing was found wrong is still no pass."""
    reasons = [] if course is Course.COMPLETE else [str(course)]
    for name, memory in memories.items():
        if memory.watched_s >= LONG_S and memory.slope().growth is Growth.TOO_SHORT:
            reasons.append(f"memory of {name} cannot be told after {memory.watched_s / 3600.0:.1f} h")
    return reasons


def memory_document(name: str, memory: Memory) -> dict[str, Any]:
    """Memory and descriptors of one process."""
    slope, curve = memory.slope(), memory.curve
    step = max(1, len(curve) // _CURVE_POINTS)
    return {
        "process": name,
        "growth": str(slope.growth),
        "kb_per_h": _finite(slope.kb_per_h),
        "interval_kb_per_h": [_finite(slope.low_kb_per_h), _finite(slope.high_kb_per_h)],
        "limit_kb_per_h": LIMIT_KB_PER_H,
        "descriptors_grow": memory.descriptors_grow(),
        "curve": [[round(t, 1), round(kb), int(n)] for t, kb, n in curve[::step].tolist()],
    }


def added(documents: Sequence[dict[str, Any]], exit_codes: Sequence[int | None] = ()) -> dict[str, Any]:
    """Several independent runs as one: counts added, findings and memories side by side, the longest time.

    `exit_codes` of the processes that had them: each must be that of a soak that passed, or found something wrong.
    """
    died = [f"job {job} ended with {code}" for job, code in enumerate(exit_codes, start=1) if code not in _SAID]
    unproven = [reason for d in documents for reason in d["unproven"]] + died
    total: dict[str, Any] = {
        "passed": all(d["passed"] for d in documents) and not any(exit_codes),
        "unproven": unproven,
        "untold": [name for d in documents for name in d["untold"]],
        "interrupted": any(d["interrupted"] for d in documents),
        "running": any(d["running"] for d in documents),
        "wall_s": max(d["wall_s"] for d in documents),
        **{name: sum(d[name] for d in documents) for name in _ADDED},
        "findings": [finding for d in documents for finding in d["findings"]],
        "memory": [memory for d in documents for memory in d["memory"]],
    }
    for name in ("wrong", "moves", "endings", "gain_sets", "excused"):
        total[name] = dict(sum((Counter(d[name]) for d in documents), Counter()))
    kinds = sorted({kind for d in documents for kind in d["faults"]})
    total["faults"] = {k: _added_fault([d["faults"][k] for d in documents if k in d["faults"]]) for k in kinds}
    return total


def _added_fault(faults: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One kind of fault of several runs."""
    total: dict[str, Any] = {name: sum(f[name] for f in faults) for name in COUNTED}
    total["latched"] = dict(sum((Counter(f["latched"]) for f in faults), Counter()))
    for name in ("detected", "left_command", "torque_gone"):
        bins = sum((Counter({int(place): n for place, n in f[name]["bins_ms"].items()}) for f in faults), Counter())
        total[name] = {
            "count": bins.total(),
            "median_ms": median_ms(bins),
            "largest_ms": max(f[name]["largest_ms"] for f in faults),
            "bins_ms": {str(place): bins[place] for place in sorted(bins)},
        }
    return total


def _finite(value: float) -> float | None:
    return round(value, 1) if math.isfinite(value) else None
