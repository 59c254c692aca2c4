"""What a figure shows, apart from how it is drawn: curves in panels, with units on every axis.

Behind everything. Functions of `figures` make a `Figure` from results; `page` with page.js draws it on a page
and `pictures` with matplotlib, so that both show the same. Colours are Okabe's and Ito's, which colour-blind readers
tell apart, and line styles differ as well, so that a figure survives black and white.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servod.common.errors import visible

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
    """Scale of an axis; the values are what matplotlib calls it."""

    LINEAR = "linear"
    LOG = "log"


class Worded:
    """What is drawn with words that may come from a file's name: none of them acts on what stands beside it."""

    def __post_init__(self) -> None:
        for key in (field.name for field in fields(self) if field.name != "name"):  # type: ignore[arg-type]
            words = getattr(self, key)
            if isinstance(words, str):
                object.__setattr__(self, key, visible(words))


@dataclass(frozen=True)
class Curve(Worded):
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
class PlotAxis(Worded):
    """One axis: its label with the unit, its scale, and its range where the data should not choose it.

    `names` stand at 0, 1, 2, ... in place of numbers.
    """

    label: str
    scale: ScaleKind = ScaleKind.LINEAR
    span: tuple[float, float] | None = None
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlotPanel(Worded):
    """One pair of axes with its curves."""

    x: PlotAxis
    y: PlotAxis
    curves: tuple[Curve, ...]
    title: str = ""


@dataclass(frozen=True)
class Figure(Worded):
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


# --- Long series -----------------------------------------------------------------------------------------------------
# Thinned for the pictures so that no peak is lost.


Series = NDArray[np.float64]

#: Lowest and highest for each of 900 columns, about a pixel each; more points than this cannot be seen.
_POINTS = 1800


def thin(x: Series, values: Series, points: int = _POINTS) -> tuple[Series, Series]:
    """At most about `points` samples of a series, in their order: those of `extremes`."""
    index = extremes(values, points)
    return x[index], values[index]


def extremes(values: Series, most: int) -> NDArray[np.intp]:
    """Places of at most `most` values that look like all of them: the first and the last, and of equal bins the lowest,
    the highest, and one that is no number where there is one, so that a gap stays a gap.
    """
    rows = np.arange(len(values))
    if len(values) <= most:
        return rows
    no_number = bool(np.isnan(values).any())
    width = -(-len(values) // max((most - 2) // (3 if no_number else 2), 1))
    table = np.pad(values, (0, -len(values) % width), constant_values=np.nan).reshape(-1, width)
    holes, begins = np.isnan(table), rows[::width]
    kept = [
        begins + np.where(holes, np.inf, table).argmin(axis=1),
        begins + np.where(holes, -np.inf, table).argmax(axis=1),
    ]
    if no_number:
        first = begins + holes.argmax(axis=1)
        kept.append(first[holes.any(axis=1) & (first < len(values))])
    return np.unique(np.concatenate([*kept, rows[[0, -1]]]))
