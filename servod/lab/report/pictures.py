"""Draws a figure with matplotlib and writes it as PNG and SVG, for documents and print.

Between the description of a figure and files; `page` with page.js draws the same on a page. The same
figure gives the same bytes: no dates, no random ids.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from servod.common.files import write_bytes
from servod.lab.report.figure import Curve, Figure, PlotAxis, PlotPanel, ScaleKind, Style, thin

FORMATS = ("png", "svg")
_DASHES = {Style.LINE: "-", Style.DASHED: (0, (5, 2)), Style.DOTTED: (0, (1, 1.5)), Style.POINTS: "-"}
_ROW_IN, _HEAD_IN = 2.3, 0.9
#: Width of the whole picture by its columns.
_WIDTH_IN = {1: 7.2, 2: 8.6}
_WIDEST_IN = 11.0
#: Size of a letter of the legend, and what a curve's sample takes of it in letters.
_LETTERS_PER_IN, _HANDLE_LETTERS = 13.0, 7
_LOOK: Any = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "savefig.dpi": 160,
    "svg.hashsalt": "servod",
}


def write_pictures(figure: Figure, folder: Path, formats: tuple[str, ...] = FORMATS) -> list[Path]:
    """Write the figure as `<name>.<format>` into `folder`, each file aside and then renamed. Raises BadInput."""
    with matplotlib.rc_context(_LOOK):
        canvas = _canvas(figure)
        return [write_bytes(folder / f"{figure.name}.{kind}", _encoded(canvas, kind)) for kind in formats]


def _encoded(canvas: Canvas, kind: str) -> bytes:
    buffer = io.BytesIO()
    canvas.savefig(buffer, format=kind, metadata={"Date": None} if kind == "svg" else {"Software": None})
    return buffer.getvalue()


def _canvas(figure: Figure) -> Canvas:
    width = _WIDTH_IN.get(figure.columns, _WIDEST_IN)
    height = _HEAD_IN + _ROW_IN * figure.row_height * figure.rows
    canvas = Canvas(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.subplots(figure.rows, figure.columns, squeeze=False).ravel()
    for drawn, panel in zip(axes, figure.panels, strict=False):
        _draw(drawn, panel)
    for unused in axes[len(figure.panels) :]:
        unused.set_visible(False)
    canvas.suptitle(figure.title, fontsize=11)
    _legend(canvas, axes)
    return canvas


def _legend(canvas: Canvas, axes: Any) -> None:
    """One legend below all panels, each label once."""
    entries: dict[str, Any] = {}
    for drawn in axes:
        for handle, label in zip(*drawn.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if len(entries) > 1:
        room = canvas.get_figwidth() * _LETTERS_PER_IN / (max(map(len, entries)) + _HANDLE_LETTERS)
        columns = max(1, min(len(entries), int(room)))
        canvas.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=columns, frameon=False)


def _draw(drawn: Any, panel: PlotPanel) -> None:
    for curve in panel.curves:
        _curve(drawn, curve)
    drawn.set_title(panel.title, loc="left")
    for axis, name in ((panel.x, "x"), (panel.y, "y")):
        _axis(drawn, axis, name)


def _axis(drawn: Any, axis: PlotAxis, name: str) -> None:
    getattr(drawn, f"set_{name}label")(axis.label)
    getattr(drawn, f"set_{name}scale")(axis.scale.value)
    if axis.names:
        getattr(drawn, f"set_{name}ticks")(range(len(axis.names)), axis.names)
    elif axis.scale is ScaleKind.LINEAR:
        drawn.ticklabel_format(axis=name, style="sci", scilimits=(-4, 5), useMathText=True)
    if axis.span is not None:
        getattr(drawn, f"set_{name}lim")(*axis.span)


def _curve(drawn: Any, curve: Curve) -> None:
    colour = curve.colour.value
    if curve.style is Style.BARS:
        drawn.barh(curve.y, curve.x, curve.width, color=colour, label=curve.label or None)
        return
    if curve.style is Style.POINTS:
        drawn.plot(curve.x, curve.y, "o", color=colour, markersize=3.5, label=curve.label or None)
        if curve.bounds is not None:
            bars = np.array([curve.y - curve.bounds[0], curve.bounds[1] - curve.y])
            drawn.errorbar(curve.x, curve.y, yerr=bars, fmt="none", ecolor=colour, elinewidth=1.0)
        return
    if curve.bounds is not None:
        drawn.fill_between(curve.x, *curve.bounds, color=colour, alpha=0.18, linewidth=0)
    x, y = thin(curve.x, curve.y)
    drawn.plot(
        x, y, color=colour, linewidth=0.85 * curve.width, linestyle=_DASHES[curve.style], label=curve.label or None
    )
