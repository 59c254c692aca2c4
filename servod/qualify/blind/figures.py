"""The pictures of a trial: who was taken for whom, and whether stated confidence is to be believed.

Drawn from the JSON document, with plotly for the page and with matplotlib as PNG, both the same.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import plotly.graph_objects as go
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from servod.common.report_files import write_bytes
from servod.lab.report.figure import Axis, Colour, Figure, Panel, Style, curve
from servod.lab.report.page_figure import plotly_figure
from servod.lab.report.pictures import write_pictures
from servod.qualify.blind.tables import CONFIDENCE, EFFECTS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Matrix:
    """A matrix of shares by row, with the counts written into its cells."""

    name: str
    title: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    counts: Array
    caption: str
    beside: str

    @property
    def shares(self) -> Array:
        """Counts over the sum of their row."""
        return np.asarray(self.counts / np.maximum(self.counts.sum(axis=1, keepdims=True), 1.0))

    def plotly(self) -> go.Figure:
        """For the page."""
        written = [[f"{n:.0f}" if n else "" for n in row] for row in self.counts]
        place: Any = {"z": self.shares, "x": self.columns, "y": self.rows, "text": written}
        cells = go.Heatmap(**place, texttemplate="%{text}", colorscale="Blues", zmin=0, zmax=1, showscale=False)
        drawn = go.Figure(cells)
        drawn.update_layout(title=self.title, height=230 + 24 * len(self.rows))
        drawn.update_yaxes(autorange="reversed", title="concealed", automargin=True)
        drawn.update_xaxes(title="answer", tickangle=-60, automargin=True)
        return drawn

    def write(self, folder: Path) -> None:
        """As PNG, for documents. Raises BadInput."""
        with matplotlib.rc_context({"font.size": 8, "savefig.dpi": 160}):
            canvas = Canvas(figsize=(2.5 + 0.32 * len(self.columns), 2.2 + 0.26 * len(self.rows)), layout="constrained")
            FigureCanvasAgg(canvas)
            axes = canvas.subplots()
            axes.imshow(self.shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
            axes.set_xticks(range(len(self.columns)), self.columns, rotation=60, ha="right", rotation_mode="anchor")
            axes.set_yticks(range(len(self.rows)), self.rows)
            axes.set_xlabel("answer")
            axes.set_ylabel("concealed")
            for (row, column), count in np.ndenumerate(self.counts):
                if count:
                    colour = "white" if self.shares[row, column] > 0.5 else "black"
                    axes.text(column, row, f"{count:.0f}", ha="center", va="center", color=colour)
            canvas.suptitle(self.title)
            out = io.BytesIO()
            canvas.savefig(out, format="png", metadata={"Software": None})
        write_bytes(folder / f"{self.name}.png", out.getvalue())


@dataclass(frozen=True)
class Drawn:
    """A figure of the project's own kind."""

    figure: Figure
    beside: str

    @property
    def caption(self) -> str:
        """What is seen."""
        return self.figure.caption

    def plotly(self) -> go.Figure:
        """For the page."""
        return plotly_figure(self.figure)

    def write(self, folder: Path) -> None:
        """As PNG, for documents. Raises BadInput."""
        write_pictures(self.figure, folder, ("png",))


def confusion(found: Mapping[str, Any]) -> Matrix:
    """Concealed against answered, of all cases."""
    table: Mapping[str, Mapping[str, int]] = found["confusion"]
    rows = tuple(table)
    answered = {answer for row in table.values() for answer in row}
    columns = (*(row for row in rows if row in answered), *sorted(answered - set(rows)))
    counts = np.array([[float(table[row].get(column, 0)) for column in columns] for row in rows])
    caption = "Rows: what was concealed, each effect of a pair by itself; columns: what the answer says. On the "
    caption += "diagonal it was named; `adequate` is what was missed."
    return Matrix(
        "confusion", "What was taken for what", rows, columns, counts.reshape(len(rows), -1), caption, EFFECTS
    )


def calibration(found: Mapping[str, Any]) -> Drawn:
    """Stated confidence against the share of findings that are right."""
    bins = [part for part in found["calibration"] if part["cases"]]
    stated = np.array([part["stated"] for part in bins], dtype=np.float64)
    right = np.array([part["share"] for part in bins], dtype=np.float64)
    low, high = (np.array([part["interval"][i] for part in bins], dtype=np.float64) for i in (0, 1))
    curves = (
        curve("as good as stated", [0.0, 1.0], [0.0, 1.0], Colour.GREY, Style.DASHED),
        curve("findings", stated, right, Colour.BLUE, Style.POINTS, bounds=(low, high)),
    )
    panel = Panel(Axis("stated confidence", span=(0.0, 1.02)), Axis("share that is right", span=(0.0, 1.02)), curves)
    caption = (
        "Each point is a bin of findings with the 95 % interval of its share; on the line, confidence is calibrated."
    )
    return Drawn(Figure("calibration", "Is a stated confidence to be believed?", (panel,), caption=caption), CONFIDENCE)
