"""Draw an exported recording: the picture of the first tutorial (docs/tutorials/first-axis.md).

    servoctl record export out/axis/recordings/first.mcap --out out/axis/first.csv
    python scripts/tutorial_picture.py out/axis/first.csv --out out/axis/first.png

Each motion of the recording is one curve over the time since it began: the errors above, each scale in a panel of its
own, torque and its friction part below. It prints the RMS error of each, without the first second. Needs the lab part.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

SETTLED_S = 1.0
WIDTH_INCHES, PANEL_INCHES, DOTS_PER_INCH = 8.0, 1.9, 80
#: An error below this share of the largest of a panel would be a flat line there.
LEAST_SHARE = 0.1
COLUMNS = ("t_s", "reference_active", "reference_rad", "position_rad", "torque_nm", "torque_friction_nm")

Samples = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """One motion: time since it began, and what the axis did meanwhile, each of shape (n,)."""

    time_s: Samples
    reference_mrad: Samples
    error_mrad: Samples
    torque_mnm: Samples
    friction_mnm: Samples

    @property
    def rms_mrad(self) -> float:
        """RMS error without the first second, in which the joint breaks away."""
        settled = self.error_mrad[self.time_s > SETTLED_S]
        return float(np.sqrt(np.mean(settled**2)))


def main() -> None:
    """Read, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="CSV of `servoctl record export`")
    parser.add_argument("--out", type=Path, required=True, help="the picture (PNG)")
    parser.add_argument("--labels", nargs="*", default=[], help="a name for each motion, in their order")
    options = parser.parse_args()
    motions = read_motions(options.recording)
    labels = [*options.labels, *(f"motion {i + 1}" for i in range(len(options.labels), len(motions)))]
    draw(motions, labels, options.out)
    for label, motion in zip(labels, motions, strict=False):
        print(f"{label:20} {motion.rms_mrad:8.3f} mrad RMS")
    print(options.out)


def read_motions(path: Path) -> list[Motion]:
    """The stretches of a recording in which a reference ran."""
    with path.open(newline="") as stream:
        table = np.array([[float(row[name]) for name in COLUMNS] for row in csv.DictReader(stream)])
    time_s, active, reference, position, torque, friction = table.T
    edges = np.flatnonzero(np.diff(np.concatenate(([0.0], active > 0, [0.0]))))
    return [
        Motion(
            time_s[begin:end] - time_s[begin],
            1e3 * (reference[begin:end] - reference[begin]),
            1e3 * (reference - position)[begin:end],
            1e3 * torque[begin:end],
            1e3 * friction[begin:end],
        )
        for begin, end in edges.reshape(-1, 2)
    ]


def by_scale(motions: Sequence[Motion]) -> list[list[int]]:
    """Places of motions whose errors are seen on one scale: each at least a tenth of the largest of them, RMS."""
    groups: list[list[int]] = []
    for place in sorted(range(len(motions)), key=lambda k: -motions[k].rms_mrad):
        if groups and motions[place].rms_mrad >= LEAST_SHARE * motions[groups[-1][0]].rms_mrad:
            groups[-1].append(place)
        else:
            groups.append([place])
    return groups


def draw(motions: Sequence[Motion], labels: Sequence[str], out: Path) -> None:
    """Reference, errors in a panel for each scale, and the torque of the last motion with its friction part."""
    groups = by_scale(motions)
    count = len(groups) + 2
    figure = Figure((WIDTH_INCHES, PANEL_INCHES * count), dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    upper, *middle, lower = figure.subplots(count, 1, sharex=True)
    last = motions[-1]
    upper.plot(last.time_s, last.reference_mrad, color="k", linewidth=0.8)
    upper.set_ylabel("reference / mrad")
    for panel, group in zip(middle, groups, strict=True):
        for place in group:
            motion, shown = motions[place], f"{labels[place]}: {motions[place].rms_mrad:.3f} mrad RMS"
            panel.plot(motion.time_s, motion.error_mrad, label=shown, color=f"C{place}", linewidth=0.8)
        panel.set_ylabel("error / mrad")
    lower.plot(last.time_s, last.torque_mnm, label=f"torque, {labels[-1]}", color="C7", linewidth=0.6)
    lower.plot(last.time_s, last.friction_mnm, label="of it the model's friction", color="C3", linewidth=0.8)
    lower.set_ylabel("torque / mN·m")
    lower.set_xlabel("time since the motion began / s")
    for panel in (upper, *middle, lower):
        panel.grid(alpha=0.3)
        panel.margins(y=0.06)  # of all rows, the jumps of the first cycles too
    for panel in (*middle, lower):  # above the panel, where there is no curve
        panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, ncols=3, fontsize=8, frameon=False)
    figure.align_ylabels()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, metadata={"Software": None})


if __name__ == "__main__":
    main()
