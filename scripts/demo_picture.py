"""Run the fast demo and draw its tracking errors: the picture of the README.

    python scripts/demo_picture.py --out docs/pictures/demo.png

The runs are those of `./demo --fast`: trajectory (19) on the shipped joint, SYNC-stepped, over CAN frames at 1 kHz. It
prints the RMS errors that stand in the picture. Needs the lab part.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from servod.qualify.demo.axis import plant_file
from servod.qualify.demo.entries import DemoRow, entries
from servod.qualify.demo.runs import Run, run_fast

DURATION_S = 30.0
SIZE_INCHES, DOTS_PER_INCH = (8.0, 5.2), 100
#: The lower panel leaves out errors beyond a tenth of the worst, which hide the others.
FINE = 0.1


def main() -> None:
    """Run, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/demo.png"), help="the picture (PNG)")
    out = parser.parse_args().out
    rows = entries([])
    runs = run_fast(plant_file(None), DURATION_S, rows, lambda _name, _share: None)
    out.parent.mkdir(parents=True, exist_ok=True)
    draw(rows, runs, out)
    for row, run in zip(rows, runs, strict=True):
        print(f"{row.label:14} {run.score().rms_error_mrad:8.3f} mrad RMS")
    print(out)


def draw(rows: Sequence[DemoRow], runs: Sequence[Run], out: Path) -> None:
    """All errors on one scale, and below them the small ones on theirs."""
    figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    worst = max(run.score().rms_error_mrad for run in runs)
    for index, (row, run) in enumerate(zip(rows, runs, strict=True)):
        score = run.score().rms_error_mrad
        for panel in (upper, lower) if score < FINE * worst else (upper,):
            curve(panel, run, f"{row.label}: {score:.3f} mrad RMS", f"C{index}")
    upper.set_title("Tracking error on trajectory (19): servoctl demo --fast", fontsize=10)
    lower.set_xlabel("time / s")
    for panel in (upper, lower):
        panel.set_ylabel("error / mrad")
        panel.grid(alpha=0.3)
    upper.legend(loc="upper right", fontsize=8, ncols=2)
    lower.legend(loc="upper right", fontsize=8, ncols=3)
    upper.set_ylim(-30.0, 52.0)
    lower.set_ylim(-5.0, 7.5)
    # The same pixels give the same file: no date, no version of the library.
    figure.savefig(out, metadata={"Software": None})


def curve(panel: Any, run: Run, label: str, colour: str) -> None:
    """One error over time, with its first second, which is not scored."""
    panel.plot(run.time_s, np.asarray(run.error_mrad), label=label, color=colour, linewidth=0.7)


if __name__ == "__main__":
    main()
