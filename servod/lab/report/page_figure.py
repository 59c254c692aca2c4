"""Draws a figure with plotly, for the page.

Between the description of a figure and the page; `pictures` draws the same with matplotlib.
"""

from __future__ import annotations

import base64
import json

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from servod.lab.report.figure import Array, Curve, Figure, PlotAxis, PlotPanel, ScaleKind, Style, thin

_DASHES = {Style.LINE: "solid", Style.DASHED: "dash", Style.DOTTED: "dot", Style.POINTS: "solid"}
_ROW_PX, _GAP_PX = 270, 85
#: Room above the panels for title and legend.
HEAD_PX = 110
_FOOT_PX = 50


def plotly_figure(figure: Figure) -> go.Figure:
    """The figure as plotly draws it: panels in a grid, one legend above all of them."""
    height = HEAD_PX + _FOOT_PX + round(_ROW_PX * figure.row_height) * figure.rows + _GAP_PX * (figure.rows - 1)
    drawn = make_subplots(
        rows=figure.rows,
        cols=figure.columns,
        subplot_titles=[panel.title for panel in figure.panels],
        vertical_spacing=_GAP_PX / (height - HEAD_PX - _FOOT_PX) if figure.rows > 1 else 0.0,
        horizontal_spacing=0.22 / figure.columns,
    )
    named: set[str] = set()
    for index, panel in enumerate(figure.panels):
        _draw(drawn, panel, 1 + index // figure.columns, 1 + index % figure.columns, named)
    drawn.update_layout(
        title={"text": figure.title, "y": 1.0, "yref": "container", "yanchor": "top", "pad": {"t": 12}},
        height=height,
        legend={"orientation": "h", "x": 0.0, "y": 1.0, "yref": "container", "yanchor": "top", "xanchor": "left"},
    )
    drawn.update_layout(legend={"y": 1.0 - 38.0 / height})
    return drawn


#: Rows that a page keeps of a curve: ten minutes at 1 kHz, four bytes each and eight for the time.
_MOST_ROWS = 600_000
#: What is in view is drawn whole up to so many rows of a curve; of more, lowest and highest of each bin.
_IN_VIEW = 4000
#: Runs on the page: whenever another part comes into view, each curve is drawn anew from all its rows. A bin gives its
#: lowest and its highest row, as `thin` does, so that a fast sine is a band from afar and a sine from near.
_EVERY_ROW_JS = """
const unpacked = (text, kind) => new kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
function place(x, t) {
  let a = 0, b = x.length;
  while (a < b) { const m = (a + b) >> 1; if (x[m] < t) a = m + 1; else b = m; }
  return a;
}
function view(x, y, from, to, most) {
  const a = Math.max(place(x, from) - 1, 0), b = Math.min(place(x, to) + 1, x.length);
  if (b - a <= most) return [Array.from(x.subarray(a, b)), Array.from(y.subarray(a, b))];
  const bins = most >> 1, xs = [], ys = [];
  for (let k = 0; k < bins; k++) {
    const p = a + Math.floor((k * (b - a)) / bins), q = a + Math.floor(((k + 1) * (b - a)) / bins);
    let low = p, high = p;
    for (let i = p + 1; i < q; i++) {
      if (y[i] < y[low] || Number.isNaN(y[low])) low = i;
      if (y[i] > y[high] || Number.isNaN(y[high])) high = i;
    }
    for (const i of low === high ? [low] : [Math.min(low, high), Math.max(low, high)]) { xs.push(x[i]); ys.push(y[i]); }
  }
  return [xs, ys];
}
"""
_REDRAW_JS = """
const plot = document.getElementById("{plot_id}");
const times = kept.times.map((text) => unpacked(text, Float64Array));
const curves = kept.curves.map((c) => [times[c.time], unpacked(c.y, Float32Array)]);
plot.on("plotly_relayout", (change) => {
  const moved = Object.keys(change).filter((key) => key.startsWith("xaxis"));
  if (!moved.length) return;
  const all = moved.some((key) => key.endsWith("autorange"));
  const [from, to] = all ? [-Infinity, Infinity] : plot.layout.xaxis.range;
  const drawn = curves.map(([x, y]) => view(x, y, from, to, kept.most));
  Plotly.restyle(plot, { x: drawn.map((d) => d[0]), y: drawn.map((d) => d[1]) }, curves.map((_, i) => i));
});
"""


def every_row_script(figure: Figure) -> str:
    """Script for the page that draws what is zoomed into from all rows of the curves, not from those in the picture.

    `figure` has lines without bounds alone, so that each curve is one trace.
    """
    times: dict[int, int] = {}
    packed: list[str] = []
    curves = []
    for curve in (curve for panel in figure.panels for curve in panel.curves):
        x, y = _at_most(curve.x, curve.y, _MOST_ROWS)
        key = id(curve.x) if x is curve.x else id(curve)
        if key not in times:
            times[key] = len(packed)
            packed.append(_packed(x, "<f8"))
        curves.append({"time": times[key], "y": _packed(y, "<f4")})
    kept = json.dumps({"times": packed, "curves": curves, "most": _IN_VIEW})
    return f"{_EVERY_ROW_JS}const kept = {kept};\n{_REDRAW_JS}"


def _packed(values: Array, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def _at_most(x: Array, y: Array, most: int) -> tuple[Array, Array]:
    """A curve that is longer than `most` as lowest and highest row of equal bins."""
    if len(y) <= most:
        return x, y
    width = -(-len(y) // (most // 2))
    whole = len(y) // width * width
    begins = np.arange(0, whole, width)
    bins = y[:whole].reshape(-1, width)
    kept = np.unique(np.concatenate([begins + bins.argmin(axis=1), begins + bins.argmax(axis=1), [len(y) - 1]]))
    return x[kept], y[kept]


def _draw(drawn: go.Figure, panel: PlotPanel, row: int, column: int, named: set[str]) -> None:
    for curve in panel.curves:
        if curve.bounds is not None and curve.style is not Style.POINTS:
            drawn.add_trace(_band(curve, *curve.bounds), row=row, col=column)
        trace = _bars if curve.style is Style.BARS else _trace
        drawn.add_trace(trace(curve, bool(curve.label) and curve.label not in named), row=row, col=column)
        named.add(curve.label)
    drawn.update_xaxes(**_axis(panel.x), row=row, col=column)
    drawn.update_yaxes(**_axis(panel.y), row=row, col=column)


def _axis(axis: PlotAxis) -> dict[str, object]:
    settings: dict[str, object] = {"title": {"text": axis.label, "standoff": 6}, "type": axis.scale.value}
    if axis.scale is ScaleKind.LOG:
        settings |= {"exponentformat": "power", "dtick": 1}
    if axis.names:
        settings |= {"tickvals": list(range(len(axis.names))), "ticktext": list(axis.names), "automargin": True}
    if axis.span is not None:
        settings["range"] = [float(np.log10(v)) if axis.scale is ScaleKind.LOG else v for v in axis.span]
    return settings


def _trace(curve: Curve, first: bool) -> go.Scatter:
    """One curve, thinned for the eye; points are drawn as they are, with their intervals as bars."""
    points = curve.style is Style.POINTS
    x, y = (curve.x, curve.y) if points else thin(curve.x, curve.y)
    bars = None
    if points and curve.bounds is not None:
        low, high = curve.bounds
        bars = {"type": "data", "symmetric": False, "array": high - curve.y, "arrayminus": curve.y - low}
    return go.Scatter(
        x=x.astype(np.float32),
        y=y.astype(np.float32),
        name=curve.label or curve.detail,
        legendgroup=curve.label,
        showlegend=first,
        mode="markers" if points else "lines",
        line={"color": curve.colour.value, "width": curve.width, "dash": _DASHES[curve.style]},
        marker={"color": curve.colour.value, "size": 6},
        error_y=bars,
        hovertext=curve.detail or None,
    )


def _bars(curve: Curve, first: bool) -> go.Bar:
    """Lying bars."""
    return go.Bar(
        x=curve.x.astype(np.float32),
        y=curve.y.astype(np.float32),
        orientation="h",
        width=curve.width,
        name=curve.label or curve.detail,
        legendgroup=curve.label,
        showlegend=first,
        marker={"color": curve.colour.value},
    )


def _band(curve: Curve, low: Array, high: Array) -> go.Scatter:
    """The area between both bounds, in a pale shade of the curve."""
    red, green, blue = (int(curve.colour.value[i : i + 2], 16) for i in (1, 3, 5))
    return go.Scatter(
        x=np.concatenate([curve.x, curve.x[::-1]]),
        y=np.concatenate([high, low[::-1]]),
        fill="toself",
        fillcolor=f"rgba({red},{green},{blue},0.18)",
        line={"width": 0},
        hoverinfo="skip",
        legendgroup=curve.label,
        showlegend=False,
    )
