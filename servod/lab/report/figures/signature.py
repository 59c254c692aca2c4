"""The signature picture of a finding: what was left without its term, and the term over it.

Stands on the result of a diagnosis; one figure for each term of a finding, over the coordinate where its effect shows.
"""

from __future__ import annotations

from collections.abc import Iterator

from servod.lab.diagnose.result import ResidualTable, Signature, SignaturePart, Units
from servod.lab.report.figure import Colour, Curve, Figure, PlotAxis, PlotPanel, Style, curve

#: Colours of the fitted effect and of the error without it, for the first part of the rows and for the second.
_COLOURS = ((Colour.BLUE, Colour.ORANGE), (Colour.GREEN, Colour.YELLOW))


def signature_figure(found: Signature, effect: str, units: Units) -> Figure:
    """Error without the term over the coordinate of `effect`, the fitted term, and a stretch of time."""
    panels = (_over_coordinate(found, units), _over_time(found, units))
    caption = (
        "Points: the error of the model without this effect, with twice its standard error. Line: what the fitted "
        "effect makes of it. Second panel: the stretch of time in which the effect acts most."
    )
    return Figure(f"finding_{effect}_{found.number}", f"The signature of {effect}", panels, 2, caption, 1.35)


def _over_coordinate(found: Signature, units: Units) -> PlotPanel:
    label = found.coordinate + ("" if found.unit == "1" else f" in {found.unit}")
    if found.period is not None:
        label = f"position within a period of {found.period:.4g} {found.unit}, in {found.unit}"
    curves: list[Curve] = []
    for part, (colour, dots) in zip(found.parts, _COLOURS, strict=False):
        curves += _binned(part, colour, dots)
    return PlotPanel(PlotAxis(label), PlotAxis(f"error in {units.force}"), tuple(curves))


def _binned(part: SignaturePart, colour: Colour, dots: Colour) -> Iterator[Curve]:
    """Points of the error, and a line of the term."""
    if part.at.size == 0:
        return
    name = f", {part.rows}" if part.rows else ""
    bounds = (part.left - part.half, part.left + part.half)
    yield curve(f"error without it{name}", part.at, part.left, dots, Style.POINTS, bounds=bounds)
    yield curve(f"fitted effect{name}", part.at, part.term, colour, width=2.0)


def _over_time(found: Signature, units: Units) -> PlotPanel:
    """The stretch of the recording in which the term takes most."""
    curves = (
        curve("error without it", found.t_s, found.without, Colour.ORANGE),
        curve("fitted effect", found.t_s, found.term, Colour.BLUE, width=2.0),
        curve("left with it", found.t_s, found.left, Colour.GREY, width=1.0),
    )
    return PlotPanel(PlotAxis("time in s"), PlotAxis(f"error in {units.force}"), curves, found.recording)


def table_figure(left: ResidualTable, units: Units) -> Figure:
    """What was left without a name, as a table over the coordinate where it lives."""
    per = {"position": units.length, "velocity": f"{units.length}/s"}.get(left.coordinate, "s")
    drawn = curve("torque that resists", left.grid, left.torque, Colour.BLUE, width=2.0)
    panel = PlotPanel(PlotAxis(f"{left.coordinate} in {per}"), PlotAxis(f"torque in {units.force}"), (drawn,))
    caption = (
        f"No known physics fits what is left. This table over {left.coordinate} takes {100.0 * left.share:.0f} % of it "
        "on stretches that it has not seen; it is kept in model.yaml without a name."
    )
    return Figure("unexplained", "What is left, without a name", (panel,), 1, caption)
