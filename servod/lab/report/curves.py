"""Time curves for the eye: long series thinned so that no peak is lost, and histograms of what a run measured.

Behind everything; stands on numpy and plotly (the lab part).
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

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
