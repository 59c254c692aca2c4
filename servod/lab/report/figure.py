"""What a figure shows, apart from how it is drawn: curves in panels, with units on every axis.

Behind everything. Functions of `figures` make a `Figure` from results; `page_figure` draws it with plotly and
`pictures` with matplotlib, so that both show the same. Colours are Okabe's and Ito's, which colour-blind readers tell
apart, and line styles differ as well, so that a figure survives black and white.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Colour(Enum):
    """Colours that differ for every kind of colour vision and in print (Okabe and Ito, 2008), and two greys."""

    BLUE = "#0072b2"
    ORANGE = "#d55e00"
    GREEN = "#009e73"
    PURPLE = "#aa4499"
    YELLOW = "#e69f00"
    SKY = "#56b4e9"
    BLACK = "#222222"
    GREY = "#9a9a9a"


#: Colours in the order in which curves of one figure take them.
COLOURS = (Colour.BLUE, Colour.ORANGE, Colour.GREEN, Colour.PURPLE, Colour.YELLOW, Colour.SKY, Colour.BLACK)


class Style(Enum):
    """How a curve is drawn."""

    LINE = "line"
    DASHED = "dashed"
    DOTTED = "dotted"
    POINTS = "points"
    BARS = "bars"  # lying: x is their length, y their place


class ScaleKind(Enum):
    """Scale of an axis; the values are what both plotting libraries call it."""

    LINEAR = "linear"
    LOG = "log"


@dataclass(frozen=True)
class Curve:
    """One curve. Curves with the same `label` share one entry of the legend, without a label they have none; `detail`
    tells curves apart under the mouse.

    `bounds` are lower and upper bounds of y, drawn as a band (as bars for points). `width` is in points; of lying bars
    it is their thickness, places being whole numbers.
    """

    label: str
    x: Array
    y: Array
    colour: Colour = Colour.BLUE
    style: Style = Style.LINE
    width: float = 1.4
    detail: str = ""
    bounds: tuple[Array, Array] | None = None


@dataclass(frozen=True)
class PlotAxis:
    """One axis: its label with the unit, its scale, and its range where the data should not choose it.

    `names` stand at 0, 1, 2, ... in place of numbers.
    """

    label: str
    scale: ScaleKind = ScaleKind.LINEAR
    span: tuple[float, float] | None = None
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlotPanel:
    """One pair of axes with its curves."""

    x: PlotAxis
    y: PlotAxis
    curves: tuple[Curve, ...]
    title: str = ""


@dataclass(frozen=True)
class Figure:
    """Panels, row by row in `columns` columns. `name` is the stem of its picture files; `caption` says what is seen."""

    name: str
    title: str
    panels: tuple[PlotPanel, ...]
    columns: int = 1
    caption: str = ""
    row_height: float = 1.0

    @property
    def rows(self) -> int:
        """Rows of panels."""
        return -(-len(self.panels) // self.columns)


@dataclass(frozen=True)
class PageTable:
    """A table of plain cells; the first column is text, the others are aligned as numbers."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """The table in Markdown, without its title."""
        lines = [self.header, ("---",) * len(self.header), *self.rows]
        return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def curve(
    label: str,
    x: ArrayLike,
    y: ArrayLike,
    colour: Colour = Colour.BLUE,
    style: Style = Style.LINE,
    width: float = 1.4,
    detail: str = "",
    bounds: tuple[Array, Array] | None = None,
) -> Curve:
    """A curve of anything that numpy takes for numbers."""
    return Curve(label, array(x), array(y), colour, style, width, detail, bounds)


def array(values: ArrayLike) -> Array:
    """`values` as numbers."""
    return np.asarray(values, dtype=np.float64)


# --- Time curves and histograms --------------------------------------------------------------------------------------
# Time curves for the eye: long series thinned so that no peak is lost, and histograms of what a run measured.


Series = NDArray[np.float64]

#: Lowest and highest for each of 900 columns, about a pixel each; more points than this cannot be seen.
_POINTS = 1800
#: Above the curves: beside them, its width would depend on the names in it.
_LEGEND = {"orientation": "h", "x": 0.0, "xanchor": "left", "y": 1.0, "yanchor": "bottom"}


def thin(time_s: Series, values: Series, points: int = _POINTS) -> tuple[Series, Series]:
    """At most about `points` samples of a series: lowest and highest of each bin, in their order in time."""
    bins = points // 2
    if len(values) <= points:
        return time_s, values
    edges = np.linspace(0, len(values), bins + 1).astype(int)
    pairs = [_extremes(values, a, b) for a, b in pairwise(edges)]
    index = np.unique(np.concatenate(pairs))
    return time_s[index], values[index]


def _extremes(values: Series, first: int, last: int) -> list[int]:
    part = values[first:last]
    return [first + int(part.argmin()), first + int(part.argmax())]


def time_curves(time_s: Series, curves: Mapping[str, Series], title: str, unit: str) -> go.Figure:
    """Several series over the same time axis; `unit` labels the vertical one.

    Drawn as SVG: browsers allow a page only a few WebGL contexts and blank the rest, some have none. The margins stay
    as they are whatever the labels, so that equal times stand below each other in all figures.
    """
    figure = go.Figure()
    for name, values in curves.items():
        x, y = thin(time_s, np.asarray(values, dtype=np.float64))
        figure.add_scatter(x=x.astype(np.float32), y=y.astype(np.float32), name=name, mode="lines", line={"width": 1.2})
    figure.update_layout(title=title, height=400, hovermode="x unified", showlegend=True, legend=_LEGEND)
    span_s = [float(time_s[0]), float(time_s[-1])] if len(time_s) else None
    figure.update_xaxes(title="time in s", range=span_s, automargin=False)
    figure.update_yaxes(title=unit, automargin=False)
    return figure


def histogram(samples: Mapping[str, Series], title: str, unit: str, bins: int = 120) -> go.Figure:
    """Distributions side by side, up to the 99.9th percentile; counts on a logarithmic axis, so that rare ones show."""
    figure = go.Figure()
    top = max(float(np.percentile(values, 99.9)) for values in samples.values())
    edges = np.linspace(0.0, max(top, 1.0), bins + 1)
    for name, values in samples.items():
        counts, _ = np.histogram(values, edges)
        figure.add_scatter(x=edges[:-1], y=counts, name=name, mode="lines", line={"shape": "hv"})
    figure.update_layout(title=title, xaxis_title=unit, yaxis_title="cycles", yaxis_type="log", height=340)
    return figure
