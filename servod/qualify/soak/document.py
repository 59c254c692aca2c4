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
from pathlib import Path
from typing import Any

import numpy as np

from servod.lab.report.figure import COLOURS, Curve, Figure, PageTable, PlotAxis, PlotPanel, Style
from servod.lab.report.page import Page, Verdict
from servod.qualify.soak.memory import LIMIT_KB_PER_H, LONG_S, Growth, Memory
from servod.qualify.soak.tally import COUNTED, SoakedAxis, median_ms

_CURVE_POINTS = 200
#: Exit codes with which `servoctl qualify soak` says what it found; None: still running.
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
        "axis_hours": counts.axis_s / 3600.0,
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
        "findings": [{**f._asdict(), "wrong": str(f.wrong)} for f in findings.anomalies],
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
            reasons.append(f"memory of {name} cannot be told after {memory.watched_s / 3600.0:.1f} h of axis time")
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
        bins = sum((Counter({int(bin_ms): n for bin_ms, n in f[name]["bins_ms"].items()}) for f in faults), Counter())
        total[name] = {
            "count": bins.total(),
            "median_ms": median_ms(bins),
            "largest_ms": max(f[name]["largest_ms"] for f in faults),
            "bins_ms": {str(bin_ms): bins[bin_ms] for bin_ms in sorted(bins)},
        }
    return total


def _finite(value: float) -> float | None:
    return round(value, 1) if math.isfinite(value) else None


# --- The page --------------------------------------------------------------------------------------------------------
# A soak as one HTML page and as a table for the terminal: what was counted, how faults were met, memory over time.


PAGE_NAME = "soak.html"
_FAULT_HEADER = (
    *("fault", "times", "in the log", "ridden through", "recovered", "latched"),
    *("detected ms", "largest", "torque gone ms", "largest"),
)


def verdict(found: dict[str, Any]) -> str:
    """The answer: what was wrong, why it is no pass, and what it does not tell."""
    faults = f"{found['faults_injected']:,} {'fault' if found['faults_injected'] == 1 else 'faults'}"
    hours = found["axis_hours"]
    span = f"{hours:.2f} h" if hours >= 0.1 else f"{3600.0 * hours:.3g} s"
    amount = f"{found['cycles']:,} cycles ({span} of axis time), {faults}"
    wrong = ", ".join(f"{count:,} {kind}" for kind, count in found["wrong"].items())
    said = [f"Wrong in {amount}: {wrong}." if wrong else f"Nothing wrong in {amount}."]
    if found["unproven"]:
        said.append(f"No pass: {', '.join(found['unproven'])}.")
    if found["excused"]:
        excused = ", ".join(f"{name} {count:,} times" for name, count in found["excused"].items())
        said.append(f"This machine was starved, which excused {excused}.")
    if found["untold"]:
        said.append(f"Whether memory grows is not told by so short a watch: {', '.join(found['untold'])}.")
    return " ".join(said)


def count_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """What was counted, in words and figures."""
    lost = found["cycles"] - found["missed"] - found["rows"]
    apart = found["rows"] - found["syncs"] - found["syncs_taken"]
    rows = [
        ("cycles of the loop", f"{found['cycles']:,}"),
        ("periods that the loop skipped", f"{found['missed']:,}"),
        ("rows recorded", f"{found['rows']:,}"),
        ("rows lost", f"{lost:,}"),
        ("SYNC frames on the bus, by a listener of its own", f"{found['syncs']:,}"),
        ("SYNC frames that faults of the schedule took", f"{found['syncs_taken']:,}"),
        ("rows without SYNC, or SYNC without row", f"{abs(apart):,}"),
        ("rows read back from recordings, byte by byte", f"{found['rows_read_back']:,}"),
        ("samples of the drive's own record", f"{found['drive_samples']:,}"),
        ("faults injected", f"{found['faults_injected']:,}"),
        ("of these due in the log / found there", f"{found['faults_due']:,} / {found['faults_found']:,}"),
        ("of these seen on the bus and ridden through", f"{found['faults_ridden_through']:,}"),
        ("of these seen on the bus, after which the wiring was tested again", f"{found['faults_spoilt_proof']:,}"),
        ("of these while the wiring was being tested", f"{found['faults_while_proving']:,}"),
        ("unexplained states, faults, torques", f"{sum(found['wrong'].values()):,}"),
        ("daemon restarts", f"{found['restarts']:,}"),
        ("wall clock, processor", f"{found['wall_s'] / 3600.0:.2f} h, {found['cpu_s'] / 3600.0:.2f} h"),
    ]
    return rows + [(f"memory of {m['process']}", memory_words(m)) for m in found["memory"]]


def memory_words(memory: dict[str, Any]) -> str:
    """Growth with its interval, and the size."""
    low, high = memory["interval_kb_per_h"]
    size_mb = memory["curve"][-1][1] / 1024.0 if memory["curve"] else 0.0
    if low is None:
        return f"{memory['growth']}, {size_mb:.0f} MB"
    slope = f"{memory['kb_per_h']:.0f} kB/h [{low:.0f}, {high:.0f}], limit {memory['limit_kb_per_h']:.0f}"
    return f"{memory['growth']}: {slope}; {size_mb:.0f} MB"


def fault_rows(found: dict[str, Any]) -> list[tuple[str, ...]]:
    """One row for each kind of fault."""
    rows = []
    for name, fault in found["faults"].items():
        latched = ", ".join(sorted(fault["latched"])) or "none"
        times = [_times(fault[key]) for key in ("detected", "torque_gone")]
        logged = f"{fault['found']} of {fault['due']}" if fault["due"] else ""
        ridden = f"{fault['ridden']}" if fault["injected"] > fault["due"] else ""
        counts = [str(fault["injected"]), logged, ridden, str(fault["recovered"])]
        rows.append((name, *counts, latched, *times[0], *times[1]))
    return rows


def write_page(found: dict[str, Any], folder: Path) -> Path:
    """Write the page into `folder`; raises BadInput when that is not possible."""
    page = Page("servod: soak", Verdict(verdict(found), not found["wrong"] and not found["unproven"]))
    page.sentence(
        f"Mode {found['mode']}, seed {', '.join(map(str, found['seeds']))}. Every cycle's record, every SYNC and every "
        "sample of the drive's own record was checked."
    )
    page.table(PageTable("Counted", ("counted", "figure"), tuple(count_rows(found))))
    if found["findings"]:
        page.heading("What was wrong")
        wrong = [(str(f["episode"]), _seconds(f["time_s"]), f["wrong"], f["text"]) for f in found["findings"]]
        page.table(PageTable("Findings", ("episode", "axis time / s", "kind", "what"), tuple(wrong)))
    page.heading("Faults and reactions")
    page.table(PageTable("By kind of fault", _FAULT_HEADER, tuple(fault_rows(found))))
    reactions = _reactions(found)
    if reactions.panels:
        page.figure(reactions)
    page.heading("Memory")
    page.figure(_memory(found))
    page.write(folder / PAGE_NAME)
    return folder / PAGE_NAME


def _times(times: dict[str, Any]) -> tuple[str, str]:
    return (str(times["median_ms"]), f"{times['largest_ms']:.1f}") if times["count"] else ("", "")


def _reactions(found: dict[str, Any]) -> Figure:
    """From the injection to the last torque, each kind in a panel of its own."""
    panels = []
    for name, fault in found["faults"].items():
        bins = {int(bin_ms): count for bin_ms, count in fault["torque_gone"]["bins_ms"].items()}
        if not bins or not fault["detected"]["count"]:
            continue
        x, counts = np.array(sorted(bins), dtype=float), np.array([bins[p] for p in sorted(bins)], dtype=float)
        curve = Curve("", x, counts, style=Style.POINTS)
        panels.append(PlotPanel(PlotAxis("ms", span=(0.0, 310.0)), PlotAxis("times"), (curve,), name))
    caption = "From the injection until the joint feels no torque, by the drive's own record, in bins of a millisecond."
    return Figure("reactions", "Time until the torque is gone", tuple(panels), 3, caption, row_height=0.5)


def _memory(found: dict[str, Any]) -> Figure:
    curves = []
    for colour, memory in zip(COLOURS, found["memory"], strict=False):
        samples = np.array(memory["curve"], dtype=float).reshape(-1, 3)
        curves.append(Curve(memory["process"], samples[:, 0] / 60.0, samples[:, 1] / 1024.0, colour))
    panel = PlotPanel(PlotAxis("axis time / min"), PlotAxis("resident / MB"), tuple(curves))
    return Figure("memory", "Resident size", (panel,), caption="Sampled from /proc while the soak ran.")


def _seconds(time_s: float | None) -> str:
    return "" if time_s is None else f"{time_s:.3f}"
