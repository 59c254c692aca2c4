"""Figures of where a mismatch lives: shares over coordinates, maps, course over time, and spectrum.

Stands on the result of a diagnosis; nothing here names any physics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from servod.lab.diagnose.result import MismatchMap, RecordingErrors, Spectrum, Units, Windows
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.report.figure import Colour, Curve, Figure, PlotAxis, PlotPanel, ScaleKind, Style, curve

#: Maps that are shown.
SHOWN = 6

#: Recordings that get a panel over time.
MOST_RECORDINGS = 6

#: Thickness of a bar that stands alone at its place, and of one of two beside each other.
BAR, HALF_BAR = 0.62, 0.36


def shares(maps: Sequence[MismatchMap]) -> dict[str, float]:
    """Share of the error by coordinate, largest first; both directions of a coordinate count as one."""
    found: dict[str, float] = {}
    for seen in maps:
        name, _, both = seen.coordinate.partition(",")
        name = f"{name}, by direction" if both else name
        found[name] = found.get(name, 0.0) + (seen.share if seen.seen else 0.0)
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def where(maps: Sequence[MismatchMap], units: Units) -> Figure:
    """The first picture: the share of the error that each coordinate orders, and the map that orders most of it."""
    found = shares(maps)
    names = tuple(reversed(found))
    bars = curve(
        "share of the error", [100.0 * found[n] for n in names], np.arange(len(names)), Colour.BLUE, Style.BARS, BAR
    )
    most = 100.0 * max([*found.values(), 0.01])
    left = PlotPanel(
        PlotAxis("share of the error in %", span=(0.0, min(100.0, 1.15 * most))), PlotAxis("", names=names), (bars,)
    )
    caption = (
        "First: how much of the error becomes a plain curve when it is drawn over a coordinate, beyond what chance "
        "would make; the shares overlap, as velocity and direction do. Second: the error over the coordinate that "
        "orders most of it, with twice its standard error."
    )
    return Figure("where", "Where the model is off", (left, map_panel(maps[0], units)), 2, caption, 1.5)


def map_panel(seen: MismatchMap, units: Units, after: MismatchMap | None = None) -> PlotPanel:
    """One map as a curve with its band; `after` in another colour beside it."""
    curves = [_mean(seen, "before", Colour.ORANGE)]
    if after is not None:
        curves.append(_mean(after, "after", Colour.BLUE))
    unit = "" if seen.unit == "1" or "modulo" in seen.coordinate else f" in {seen.unit}"
    return PlotPanel(PlotAxis(f"{seen.coordinate}{unit}"), PlotAxis(f"error in {units.force}"), tuple(curves))


def _mean(seen: MismatchMap, label: str, colour: Colour) -> Curve:
    half = 2.0 * seen.error
    style = Style.POINTS if len(seen.at) < 4 else Style.LINE
    return curve(label, seen.at, seen.mean, colour, style, bounds=(seen.mean - half, seen.mean + half))


def map_grid(before: Sequence[MismatchMap], after: Sequence[MismatchMap], units: Units) -> Figure:
    """The maps that carry most, before and after on the same scale."""
    later = {seen.coordinate: seen for seen in after}
    chosen = [seen for seen in before if seen.coordinate in later and seen.bins > 1][:SHOWN]
    panels = [map_panel(seen, units, later[seen.coordinate]) for seen in chosen]
    caption = (
        "Mean error over each coordinate with twice its standard error, before and after. Where the physics was "
        "found, the curve after lies on zero."
    )
    return Figure("maps", "The error over what the axis did, before and after", tuple(panels), 2, caption)


def over_time(recordings: Sequence[RecordingErrors], units: Units) -> Figure:
    """Root mean square of the error over time, a panel for each recording."""
    panels = []
    for one in recordings[:MOST_RECORDINGS]:
        curves = (
            curve("before", one.t_s, one.before_curve, Colour.ORANGE),
            curve("after", one.t_s, one.after_curve, Colour.BLUE),
        )
        panels.append(PlotPanel(PlotAxis("time in s"), PlotAxis(f"error in {units.force}"), curves, one.name))
    caption = (
        f"Root mean square of the error in stretches of {SETTINGS.curves.course_s:g} s, by models fitted to the other "
        "recordings."
    )
    columns = 2 if len(panels) > 1 else 1
    return Figure("over_time", "The error over time, recording by recording", tuple(panels), columns, caption, 0.85)


def spectrum(before: Spectrum, after: Spectrum, units: Units) -> Figure:
    """Power of the error over frequency, before and after."""
    shown = ((before, "before", Colour.ORANGE), (after, "after", Colour.BLUE))
    curves = [curve(label, error.frequency_hz, error.amplitude, colour) for error, label, colour in shown]
    panel = PlotPanel(
        PlotAxis("frequency in Hz", ScaleKind.LOG),
        PlotAxis(f"error in {units.force}/√Hz", ScaleKind.LOG),
        tuple(c for c in curves if c.x.size),
    )
    caption = "Amplitude of the error by frequency: a narrow peak is a resonance or a period, a broad rise is noise."
    return Figure("spectrum", "The error over frequency", (panel,), 1, caption)


def seen_by(left_out: str) -> str:
    """By what rows were judged."""
    return f"Each row is judged by a model that was fitted without it: {left_out} was left out."


def window_course(windows: Sequence[Windows], left_out: str, units: Units) -> Figure:
    """Error of windows that are simulated freely, over time, in the recording where it was largest."""
    panels = []
    for window in windows:
        factor, prefix = _prefix(float(np.max(np.abs(window.before), initial=0.0)))
        curves = (
            curve("before", window.t_s, factor * window.before, Colour.ORANGE, width=1.0),
            curve("after", window.t_s, factor * window.after, Colour.BLUE, width=1.0),
        )
        title = f"{window.worst}, windows of {window.horizon_s:g} s"
        panels.append(
            PlotPanel(PlotAxis("time in s"), PlotAxis(f"position error in {prefix}{units.length}"), curves, title)
        )
    caption = (
        "Simulated minus recorded position; the simulation begins again from the recording at every window. "
        f"{seen_by(left_out)}"
    )
    return Figure("windows", "How far a simulation strays", tuple(panels), 1, caption, 0.8)


def bars(panels: Sequence[PlotPanel], left_out: str) -> Figure:
    """Errors before and after, a panel for each kind of error."""
    rows = max(len(panel.y.names) for panel in panels)
    caption = f"Root mean square errors of each recording before and after. {seen_by(left_out)}"
    return Figure("held_out", "Errors before and after", tuple(panels), len(panels), caption, 0.45 + 0.13 * rows)


def before_after(errors: Mapping[str, tuple[float, float]], unit: str, what: str, named: bool = True) -> PlotPanel:
    """Bars of an error before and after: name -> (before, after); a panel beside a `named` one needs no names."""
    names = tuple(reversed(list(errors)))
    positions = np.arange(len(names), dtype=float)
    factor, prefix = _prefix(max(max(pair) for pair in errors.values()))
    bars = tuple(
        curve(label, [factor * errors[n][side] for n in names], positions + shift, colour, Style.BARS, HALF_BAR)
        for side, label, shift, colour in ((0, "before", 0.19, Colour.ORANGE), (1, "after", -0.19, Colour.BLUE))
    )
    return PlotPanel(
        PlotAxis(f"{what} in {prefix}{unit}"), PlotAxis("", names=names if named else ("",) * len(names)), bars
    )


def _prefix(largest: float) -> tuple[float, str]:
    """Factor and prefix of the unit that make a number easy to read."""
    power = min(max(math.ceil(-math.log10(max(largest, 1e-12)) / 3.0), 0), 2)
    return (1.0, 1e3, 1e6)[power], ("", "m", "µ")[power]
