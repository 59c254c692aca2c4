"""The signature picture of a finding: what was left without its term, and the term over it.

Stands on the evidence of a diagnosis; one figure for each finding, over the coordinate where its effect shows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.judge.evidence import Evidence
from servod.lab.diagnose.judge.unnamed import Unnamed
from servod.lab.diagnose.predict.coordinates import Look, Split, coordinates, look, units
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.report.figure import Array, Axis, Colour, Curve, Figure, Panel, Style, curve

#: Bins of a signature; periods in the range from which a periodic one is drawn over one period only.
BINS, FOLD_FROM = 60, 4.0

#: The stretch of time that is drawn lasts so long, s.
STRETCH_S = 3.0

_HALVES = {Split.DIRECTION: ("forward", "back"), Split.LOAD: ("command above zero", "command below zero")}


def signature(evidence: Evidence, effect: str, place: int) -> Figure:
    """Error without the term at `place` over the coordinate of `effect`, the fitted term, and a stretch of time."""
    shown = look(effect)
    panels = (_over_coordinate(evidence, place, shown), _over_time(evidence, place))
    caption = (
        "Points: the error of the model without this effect, with twice its standard error. Line: what the fitted "
        "effect makes of it. Right: the stretch of time in which the effect acts most."
    )
    return Figure(f"finding_{effect}_{place + 1}", f"The signature of {effect}", panels, 2, caption, 1.35)


def _over_coordinate(evidence: Evidence, place: int, shown: Look) -> Panel:
    predictor = evidence.predictor
    without, term = _parts(evidence, place)
    known = coordinates(predictor)
    unit, values = known.get(shown.coordinate, known["position"])
    label = f"{shown.coordinate}" + ("" if unit == "1" else f" in {unit}")
    period = _period(evidence, place, values) if shown.periodic else None
    if period is not None:
        values, label = values % period, f"position within a period of {period:.4g} {unit}, in {unit}"
    curves: list[Curve] = []
    for name, rows, colour in _splits(evidence, shown):
        curves += _binned(values, without, term, rows & predictor.counts & np.isfinite(values), name, colour)
    return Panel(Axis(label), Axis(f"error in {units(predictor).force}"), tuple(curves))


def _parts(evidence: Evidence, place: int) -> tuple[Array, Array]:
    """What is left without the term, and the part of it that the term takes, row by row."""
    without = evidence.less[place].mismatch
    return without, without - evidence.fit.mismatch


def _splits(evidence: Evidence, shown: Look) -> Iterator[tuple[str, NDArray[np.bool_], Colour]]:
    """Rows that are drawn by themselves: all, or by the sign of velocity or command."""
    if shown.split is Split.NONE:
        yield "", np.ones(len(evidence.predictor.counts), dtype=bool), Colour.BLUE
        return
    over = evidence.predictor.over("velocity" if shown.split is Split.DIRECTION else "torque")
    first, second = _HALVES[shown.split]
    yield f", {first}", over > 0.0, Colour.BLUE
    yield f", {second}", over < 0.0, Colour.GREEN


def _binned(
    values: Array, without: Array, term: Array, rows: NDArray[np.bool_], name: str, colour: Colour
) -> Iterator[Curve]:
    """Means over bins with as many rows each: points of the error, and a line of the term."""
    if int(rows.sum()) < 2 * SETTINGS.maps.least_in_bin:
        return
    edges = np.unique(np.quantile(values[rows], np.linspace(0.0, 1.0, BINS + 1)))
    place = np.clip(np.searchsorted(edges, values[rows], side="right") - 1, 0, max(len(edges) - 2, 0))
    count = np.bincount(place)
    full = count >= min(SETTINGS.maps.least_in_bin, count.max())
    middle, left, made = (
        (np.bincount(place, part[rows]) / np.maximum(count, 1))[full] for part in (values, without, term)
    )
    square = (np.bincount(place, without[rows] ** 2) / np.maximum(count, 1))[full]
    half = 2.0 * np.sqrt(np.maximum(square - left**2, 0.0) / np.maximum(count[full] / 20.0, 1.0))
    dots = Colour.ORANGE if colour is Colour.BLUE else Colour.YELLOW
    yield curve(f"error without it{name}", middle, left, dots, Style.POINTS, bounds=(left - half, left + half))
    yield curve(f"fitted effect{name}", middle, made, colour, width=2.0)


def _period(evidence: Evidence, place: int, values: Array) -> float | None:
    """The period of a periodic term where many of them lie in the range."""
    fit = evidence.fit
    told = fit.hypothesis.terms[place].tell(
        fit.hypothesis.written(fit.coordinates), fit.values[fit.hypothesis.share(place)]
    )
    found = {reported.name: reported.value for reported in told}
    if "periods_per_turn" in found:
        period = 2.0 * math.pi / found["periods_per_turn"]
    elif "periods_per_metre" in found:
        period = 1.0 / found["periods_per_metre"]
    else:
        return None
    return period if float(np.ptp(values)) > FOLD_FROM * period else None


def _over_time(evidence: Evidence, place: int) -> Panel:
    """The stretch of the recording in which the term takes most."""
    predictor = evidence.predictor
    without, term = _parts(evidence, place)
    best: tuple[float, int, int, int] = (-1.0, 0, 0, 1)
    for index, (trace, part) in enumerate(zip(predictor.traces, predictor.slices, strict=True)):
        rows = min(max(2, round(STRETCH_S / trace.period_s)), part.stop - part.start)
        power = np.concatenate([[0.0], np.cumsum(term[part] ** 2)])
        taken = power[rows:] - power[:-rows]
        first = int(np.argmax(taken))
        best = max(best, (float(taken[first]) / rows, index, first, rows))
    _, index, first, rows = best
    trace, begun = predictor.traces[index], predictor.slices[index].start + first
    here = slice(begun, begun + rows)
    t_s = trace.drive.t_s[first : first + rows] - trace.shift_s
    curves = (
        curve("error without it", t_s, without[here], Colour.ORANGE),
        curve("fitted effect", t_s, term[here], Colour.BLUE, width=2.0),
        curve("left with it", t_s, evidence.fit.mismatch[here], Colour.GREY, width=1.0),
    )
    return Panel(Axis("time in s"), Axis(f"error in {units(predictor).force}"), curves, trace.name)


def table_figure(left: Unnamed, predictor: Predictor) -> Figure:
    """What was left without a name, as a table over the coordinate where it lives."""
    unit = units(predictor)
    per = {"position": unit.length, "velocity": f"{unit.length}/s"}.get(left.coordinate, "s")
    drawn = curve("torque that resists", left.grid, left.torque, Colour.BLUE, width=2.0)
    panel = Panel(Axis(f"{left.coordinate} in {per}"), Axis(f"torque in {unit.force}"), (drawn,))
    caption = (
        f"No known physics fits what is left. This table over {left.coordinate} takes {100.0 * left.share:.0f} % of it "
        "on stretches that it has not seen; it is kept in model.yaml without a name."
    )
    return Figure("unexplained", "What is left, without a name", (panel,), 1, caption)
