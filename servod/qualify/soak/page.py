"""A soak as one HTML page and as a table for the terminal: what was counted, how faults were met, memory over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from servod.lab.report.figure import COLOURS, Axis, Curve, Figure, Panel, Style
from servod.lab.report.page import Page

PAGE_NAME = "soak.html"
_FAULT_HEADER = (
    *("fault", "times", "in the log", "ridden through", "recovered", "latched"),
    *("detected ms", "largest", "torque gone ms", "largest"),
)


def verdict(found: dict[str, Any]) -> str:
    """The answer: what was wrong, why it is no pass, and what it does not tell."""
    amount = (
        f"{found['cycles']:,} cycles ({found['axis_hours']:.2f} h of axis time), {found['faults_injected']:,} faults"
    )
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
        ("of these seen on the bus, after which the wiring was proven again", f"{found['faults_spoilt_proof']:,}"),
        ("of these while the wiring was being proven", f"{found['faults_while_proving']:,}"),
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
    page = Page("servod: soak")
    page.lead(verdict(found))
    page.sentence(
        f"Mode {found['mode']}, seed {', '.join(map(str, found['seeds']))}. Every cycle's record, every SYNC and every "
        "sample of the drive's own record was checked."
    )
    page.table(("counted", ""), count_rows(found))
    if found["findings"]:
        page.heading("What was wrong")
        page.table(
            ("episode", "axis time s", "what", ""),
            [(str(f["episode"]), _seconds(f["time_s"]), f["wrong"], f["text"]) for f in found["findings"]],
        )
    page.heading("Faults and reactions")
    page.table(_FAULT_HEADER, fault_rows(found))
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
        bins = {int(place): count for place, count in fault["torque_gone"]["bins_ms"].items()}
        if not bins or not fault["detected"]["count"]:
            continue
        x, counts = np.array(sorted(bins), dtype=float), np.array([bins[p] for p in sorted(bins)], dtype=float)
        curve = Curve("", x, counts, style=Style.POINTS)
        panels.append(Panel(Axis("ms", span=(0.0, 310.0)), Axis("times"), (curve,), name))
    caption = "From the injection until the joint feels no torque, by the drive's own record, in bins of a millisecond."
    return Figure("reactions", "Time until the torque is gone", tuple(panels), 3, caption, row_height=0.5)


def _memory(found: dict[str, Any]) -> Figure:
    curves = []
    for colour, memory in zip(COLOURS, found["memory"], strict=False):
        samples = np.array(memory["curve"], dtype=float).reshape(-1, 3)
        curves.append(Curve(memory["process"], samples[:, 0] / 60.0, samples[:, 1] / 1024.0, colour))
    panel = Panel(Axis("wall clock / min"), Axis("resident / MB"), tuple(curves))
    return Figure("memory", "Resident size", (panel,), caption="Sampled from /proc while the soak ran.")


def _seconds(time_s: float | None) -> str:
    return "" if time_s is None else f"{time_s:.3f}"
