"""A figure as a page holds it: the HTML around its panels, and every row of its curves for page.js to draw.

Between the description of a figure and the page; `pictures` draws the same with matplotlib. Rows are kept as they are,
each series once however many curves show it, up to MOST_BYTES for the whole page; what is longer keeps lowest and
highest row of equal bins.
"""

from __future__ import annotations

import base64
import html
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from servod.lab.report.figure import Array, Curve, Figure, PlotAxis, PlotPanel, ScaleKind, Style

#: Rows that a page keeps of a curve: ten minutes at 1 kHz. And of all its curves, four bytes each before deflating.
MOST_ROWS, MOST_BYTES = 600_000, 24_000_000
#: Of a series that is thinned to fit into MOST_BYTES at least so many rows stay.
_LEAST_ROWS = 4000
#: Times that differ from an even grid by less than this share of a step are that grid.
_EVEN = 1e-3
#: Rows of panels up to which a figure stands whole on a sheet of paper.
_SHORT_ROWS = 3.0
_TOOLS = (
    *(("in", "+", "Zoom in"), ("out", "−", "Zoom out"), ("left", "←", "Earlier"), ("right", "→", "Later")),
    ("all", "all", "Show all"),
)
_DASHES = {Style.DASHED: "7 4", Style.DOTTED: "2 3"}


class PageData:
    """What page.js draws from: series of numbers, and figures that name them by their place."""

    def __init__(self, figures: Sequence[Figure]) -> None:
        self._arrays: list[dict[str, Any]] = []
        self._places: dict[bytes, int] = {}
        lengths = {id(c.y): len(c.y) for f in figures for p in f.panels for c in p.curves}
        self.most_rows = _most_rows(list(lengths.values()))
        self._figures = [self._figure(figure) for figure in figures]

    def document(self) -> dict[str, Any]:
        """Plain values for the page."""
        return {"arrays": self._arrays, "figures": self._figures}

    def _figure(self, figure: Figure) -> dict[str, Any]:
        panels = [
            {
                "title": p.title,
                "x": _scale(p.x),
                "y": _scale(p.y),
                "curves": [self._curve(c, p) for c in p.curves],
            }
            for p in figure.panels
        ]
        return {"name": figure.name, "columns": figure.columns, "row_height": figure.row_height, "panels": panels}

    def _curve(self, curve: Curve, panel: PlotPanel) -> dict[str, Any]:
        held = {"label": curve.label, "detail": curve.detail, "colour": curve.colour.name.lower()}
        held |= {"style": curve.style.value, "width": curve.width}  # type: ignore[dict-item]
        x, y = at_most(curve.x, curve.y, self.most_rows)
        places: dict[str, Any] = {"x": self._series(x, precise=True), "y": self._series(y)}
        if curve.bounds is not None:
            places |= {"low": self._series(curve.bounds[0]), "high": self._series(curve.bounds[1])}
        return held | places

    def _series(self, values: Array, precise: bool = False) -> int:
        packed = packed_series(values, precise)
        key = repr(sorted(packed.items())).encode()
        if key not in self._places:
            self._places[key] = len(self._arrays)
            self._arrays.append(packed)
        return self._places[key]


def packed_series(values: Array, precise: bool = False) -> dict[str, Any]:
    """A series as the page keeps it: an even grid by its numbers, others as bytes by their place in a float, deflated.

    `precise` keeps eight bytes of each value, where four would make steps of a long time.
    """
    if precise and len(values) > 1:
        step = (values[-1] - values[0]) / (len(values) - 1)
        even = values[0] + step * np.arange(len(values))
        if step > 0.0 and float(np.abs(values - even).max()) < _EVEN * step:
            return {"n": len(values), "from": float(values[0]), "step": float(step)}
    kind, size = ("f8", 8) if precise else ("f4", 4)
    raw = np.ascontiguousarray(values, dtype=f"<{kind}").view(np.uint8).reshape(-1, size)
    return {"kind": kind, "z": base64.b64encode(zlib.compress(raw.T.tobytes(), 6)).decode()}


def at_most(x: Array, y: Array, most: int) -> tuple[Array, Array]:
    """A curve that is longer than `most` as lowest and highest row of equal bins."""
    if len(y) <= most:
        return x, y
    width = -(-len(y) // (most // 2))
    whole = len(y) // width * width
    begins = np.arange(0, whole, width)
    bins = y[:whole].reshape(-1, width)
    kept = np.unique(np.concatenate([begins + bins.argmin(axis=1), begins + bins.argmax(axis=1), [len(y) - 1]]))
    return x[kept], y[kept]


def _most_rows(lengths: list[int]) -> int:
    """The longest that a curve may be so that all of them together keep MOST_BYTES."""
    most = MOST_ROWS
    while most > _LEAST_ROWS and sum(4 * min(length, most) for length in lengths) > MOST_BYTES:
        most = max(most * 4 // 5, _LEAST_ROWS)
    return most


def _scale(axis: PlotAxis) -> dict[str, Any]:
    scale: dict[str, Any] = {"label": axis.label, "log": axis.scale is ScaleKind.LOG}
    if axis.span is not None:
        scale["span"] = [float(end) for end in axis.span]
    if axis.names:
        scale["names"] = list(axis.names)
    return scale


def figure_html(figure: Figure) -> str:
    """The figure without its curves: title, legend, tools, a place for each panel, caption."""
    name = html.escape(figure.name)
    panels = "".join(_panel_html(panel, k) for k, panel in enumerate(figure.panels))
    tools = "".join(
        f'<button type="button" data-act="{act}" aria-label="{says}">{sign}</button>' for act, sign, says in _TOOLS
    )
    short = ' class="short"' if figure.rows * figure.row_height <= _SHORT_ROWS else ""
    caption = f"<figcaption>{html.escape(figure.caption)}</figcaption>" if figure.caption else ""
    return (
        f'<figure id="figure-{name}"{short} data-figure="{name}" aria-label="{html.escape(figure.title)}">'
        f'<p class="figure-title">{html.escape(figure.title)}</p>'
        f'<div class="controls"><div class="legend">{_legend(figure)}</div><div class="tools">{tools}</div></div>'
        f'<div class="panels">{panels}</div>{caption}</figure>'
    )


def _legend(figure: Figure) -> str:
    """A button for each label; one alone needs no legend."""
    first: dict[str, Curve] = {}
    for shown in (c for panel in figure.panels for c in panel.curves if c.label):
        first.setdefault(shown.label, shown)
    if len(first) < 2:
        return ""
    return "".join(
        f'<button type="button" aria-pressed="true">{_sample(curve)}{html.escape(label)}</button>'
        for label, curve in first.items()
    )


def _sample(curve: Curve) -> str:
    """How a curve looks, in small."""
    colour = f"var(--{curve.colour.name.lower()})"
    if curve.style is Style.POINTS:
        mark = f'<circle cx="11" cy="6" r="3.5" fill="{colour}"/>'
    elif curve.style is Style.BARS:
        mark = f'<rect width="22" height="9" y="1.5" fill="{colour}"/>'
    else:
        dash = f' stroke-dasharray="{_DASHES[curve.style]}"' if curve.style in _DASHES else ""
        mark = f'<path d="M0 6H22" stroke="{colour}" stroke-width="2.5"{dash}/>'
    return f'<svg width="22" height="12" aria-hidden="true">{mark}</svg>'


def _panel_html(panel: PlotPanel, number: int) -> str:
    title = f"<b>{html.escape(panel.title)}</b>" if panel.title else ""
    drawn = ", ".join(dict.fromkeys(c.label for c in panel.curves if c.label)) or "curves"
    over = " over ".join(filter(None, (panel.y.label or "states", panel.x.label)))
    says = html.escape(f"{panel.title + ': ' if panel.title else ''}{over}: {drawn}")
    return (
        f'<div class="panel" data-panel="{number}" role="group" tabindex="0" aria-label="{says}. '
        'Plus and minus zoom, arrows move, 0 shows all.">'
        f'<p class="panel-head">{title}{html.escape(panel.y.label)}<span class="y-factor"></span></p>'
        f'<svg role="img" aria-label="{says}"></svg>'
        f'<p class="panel-foot">{html.escape(panel.x.label)}<span class="x-factor"></span></p>'
        '<div class="readout" hidden></div></div>'
    )
