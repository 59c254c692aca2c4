"""Figures of the linear loop: the axis before and after compensation (Fig. 4), impulse responses w -> xi (Fig. 6).

Stands on the stored design of a gain set and the linearised loop of verification; no solver.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from servod.common.errors import BadInput
from servod.formats.gains.design import Design, RegionProof
from servod.formats.gains.gain_set import Certificate, CertificateCheck, GainSet
from servod.lab.identify.fits.response import LEAST_COHERENCE, ResponseFit, falling_phase_rad
from servod.lab.report.figure import (
    Array,
    Colour,
    Curve,
    Figure,
    PageTable,
    PlotAxis,
    PlotPanel,
    ScaleKind,
    Style,
    curve,
)
from servod.lab.report.figures.sets import local_law
from servod.lab.report.responses import (
    Complex,
    Loop,
    before,
    closed_loop_response,
    frequency_response,
    rigid,
    vertex_impulse,
)
from servod.lab.verify.margins import MARGINS

#: Velocities of both halves of Fig. 4 [rad/s]: creeping (and at rest), and where trajectory (19) is fast.
LOW_VELOCITIES, HIGH_VELOCITIES = (0.0, 0.001), (0.05, 0.2)
_POINTS = 400
_ANCHOR_HZ, _ANCHOR_DEGREES = 100.0, -220.0
#: Impulse responses are drawn until the slowest has come down to this share of its peak, at most this long.
_FADED, _LONGEST_S = 0.02, 1.0


def design_of(gains: GainSet) -> Design:
    """The design in the set. Raises BadInput when it has none."""
    if gains.design is None:
        raise BadInput(f"gain set {gains.name}: design", "nothing", "a design, as `servoctl synthesize` writes it")
    return gains.design


def bode(
    gains: GainSet,
    low: tuple[float, ...] = LOW_VELOCITIES,
    high: tuple[float, ...] = HIGH_VELOCITIES,
    name: str = "bode",
) -> Figure:
    """Position over torque command before and after compensation, very low velocities and higher ones (Fig. 4).

    Raises BadInput for a set without a design, or for another law than the local one.
    """
    design, law = design_of(gains), local_law(gains)
    frequencies = np.geomspace(0.1, 0.45 / design.period_s, _POINTS)

    def drawn(label: str, loop: Loop, colour: Colour, style: Style) -> tuple[Curve, Curve]:
        return curve_pair(label, frequency_response(*loop, design.period_s, frequencies), frequencies, colour, style)

    columns = []
    for velocities in (low, high):
        ideal = rigid(design, frequencies)
        pairs = [curve_pair("rigid joint without friction", ideal, frequencies, Colour.ORANGE, Style.DOTTED)]
        for v, style in zip(velocities, (Style.LINE, Style.DASHED), strict=False):
            pairs.append(drawn("before", before(design, v), Colour.GREY, style))
            pairs.append(drawn("after (9)", closed_loop_response(design, law, v, False), Colour.BLACK, style))
            if law.disturbance_observer is not None:
                observed = closed_loop_response(design, law, v, True)
                pairs.append(drawn("after, with the output observer", observed, Colour.BLUE, style))
        columns.append(pairs)
    return _bode_figure(name, columns, (low, high))


def _bode_figure(
    name: str, columns: list[list[tuple[Curve, Curve]]], velocities: tuple[tuple[float, ...], ...]
) -> Figure:
    """Magnitudes above phases, a column for each range of velocities."""
    x = PlotAxis("frequency in Hz", ScaleKind.LOG)
    labels = (PlotAxis("position/torque in rad/(N·m)", ScaleKind.LOG), PlotAxis("phase in degrees"))
    titles = [
        f"{kind}: " + ", ".join(f"{v:g}" for v in speeds) + " rad/s (solid, dashed)"
        for kind, speeds in zip(("very low", "higher"), velocities, strict=True)
    ]
    panels = [
        PlotPanel(x, label, tuple(pair[part] for pair in pairs), title if part == 0 else "")
        for part, label in enumerate(labels)
        for pairs, title in zip(columns, titles, strict=True)
    ]
    caption = (
        "Sampled joint with its delay, from torque command to position. Compensation with the measured velocity, "
        "feedback and l_i left out."
    )
    return Figure(name, "Frequency response before and after compensation", tuple(panels), 2, caption)


def curve_pair(
    label: str, response: Complex, frequencies: np.ndarray, colour: Colour, style: Style
) -> tuple[Curve, Curve]:
    """Magnitude and phase in degrees, unwrapped, so that all are near each other where only the inertia counts."""
    phase = np.degrees(np.unwrap(np.angle(response)))
    middle = int(np.searchsorted(frequencies, _ANCHOR_HZ))
    phase -= 360.0 * np.round((phase[middle] - _ANCHOR_DEGREES) / 360.0)
    return (
        curve(label, frequencies, np.abs(response), colour, style),
        curve(label, frequencies, phase, colour, style),
    )


#: Colour and legend of a vertex by how its name begins.
_KINDS = {
    "sliding falling": ("sliding, friction falls with speed", Colour.ORANGE),
    "sliding rising": ("sliding, friction rises with speed", Colour.BLUE),
    "sticking": ("sticking on the bristle", Colour.GREEN),
}


def impulse_responses(gains: GainSet, name: str = "impulse_responses") -> Figure:
    """w -> xi = [alpha*x, beta*u] at every vertex of both regions under their feedback (Fig. 6), scaled units.

    Raises BadInput for a set without a design.
    """
    design = design_of(gains)
    if not design.regions:
        raise BadInput(f"gain set {gains.name}: design.regions", "none", "the proofs of both regions")
    columns = [_impulses(region, design.period_s) for region in design.regions]
    panels = [
        PlotPanel(
            PlotAxis("time in s"),
            PlotAxis(label),
            tuple(curves[part] for curves in drawn),
            _region_title(region) if part == 0 else "",
        )
        for part, label in enumerate(("α·x, scaled", "β·u, scaled"))
        for region, drawn in zip(design.regions, columns, strict=True)
    ]
    caption = "A torque pulse of one cycle at the joint. " + " ".join(
        _norms(r, design.period_s) for r in design.regions
    )
    return Figure(name, "Impulse responses w → ξ at every vertex", tuple(panels), 2, caption)


def _region_title(region: RegionProof) -> str:
    symbol = {"low": "Ω_L", "high": "Ω_H"}.get(region.name, region.name)
    return f"{symbol}: {region.speed_from_rad_s:g} to {region.speed_to_rad_s:g} rad/s, {len(region.vertices)} vertices"


def _impulses(region: RegionProof, period_s: float) -> list[tuple[Curve, Curve]]:
    """Both outputs of every vertex, cut where all have faded."""
    responses = [vertex_impulse(region, vertex, round(_LONGEST_S / period_s)) for vertex in region.vertices]
    alive = [np.flatnonzero(np.abs(r[:, 0]) > _FADED * np.abs(r[:, 0]).max())[-1] for r in responses]
    end = min(len(responses[0]), 1 + int(max(alive)))
    t = np.arange(end) * period_s
    drawn = []
    for vertex, response in zip(region.vertices, responses, strict=True):
        label, colour = next(k for start, k in _KINDS.items() if vertex.name.startswith(start))
        x, u = (curve(label, t, response[:end, i], colour, width=1.0, detail=vertex.name) for i in (0, 1))
        drawn.append((x, u))
    return drawn


def _norms(region: RegionProof, period_s: float) -> str:
    """The largest H2 norm among the vertices where it counts, beside the proven bound."""
    counted = [v for v in region.vertices if v.output is not None]
    samples = round(_LONGEST_S / period_s)
    largest = max(float(np.sqrt(np.sum(vertex_impulse(region, v, samples) ** 2))) for v in counted)
    bound = max(float(np.sqrt(np.trace(np.array(v.output)))) for v in counted)
    return f"Region {region.name}: norm of the worst response {largest:.3g}, proven bound {bound:.3g}."


# --- The certificate as a table --------------------------------------------------------------------------------------
# The certificate of a gain set as a table: every check with its figure, limit and margin.


class Judged(Protocol):
    """A verdict with its figures: a certificate, or what the checks said of a set that got none."""

    @property
    def valid(self) -> bool:
        """Whether all checks passed."""
        ...

    @property
    def checks(self) -> list[CertificateCheck]:
        """Each with figure and limit."""
        ...

    @property
    def observations(self) -> dict[str, float]:
        """Told, not judged."""
        ...


#: Titles of tables that a page folds begin so.
PASSED = "Passed"
#: So many passed checks stand open: those that have used most of their limit.
_TIGHTEST = 5


def certificate_tables(gains: GainSet) -> Iterator[PageTable]:
    """Margins in a drive engineer's units; checks that failed, then the tightest; the others, to be folded.

    Raises BadInput for a set without a certificate.
    """
    return judged_tables(_certificate(gains))


def judged_tables(certificate: Judged) -> Iterator[PageTable]:
    """The same of any verdict on a set, also where no certificate was issued."""
    header = ("margin", "value", "unit", "textbooks ask for", "what it is")
    yield PageTable("Margins of the loop, the least over all speeds", header, tuple(margin_rows(certificate)))
    checks = sorted(certificate.checks, key=lambda check: (check.passed, -limit_used(check)))
    first = sum(not check.passed for check in checks) + _TIGHTEST
    verdict = "valid" if certificate.valid else "not valid"
    title = f"Certificate: {verdict}. Of {len(checks)} checks the failed, then the {_TIGHTEST} nearest to their limit"
    yield PageTable(title, _HEADER, tuple(map(_check_row, checks[:first])))
    yield PageTable(
        f"{PASSED}: the other {len(checks[first:])} checks", _HEADER, tuple(map(_check_row, checks[first:]))
    )


_HEADER = ("check", "figure", "limit", "limit used", "verdict")


def _check_row(check: CertificateCheck) -> tuple[str, ...]:
    used = f"{100.0 * limit_used(check):.0f} %"
    if _exact(check):
        used = "met exactly"
    return check.name, f"{check.value:.4g}", f"{check.limit:.4g}", used, _verdict(check.passed)


def limit_used(check: CertificateCheck) -> float:
    """How much of its limit a check has used: 1 at the limit, 0 far from it.

    What keeps its limit exactly, as a count does, has no margin to lose and is 0. Of a pole its distance from the unit
    circle counts, which is what its decay goes by.
    """
    value, limit = check.value, check.limit
    if _exact(check):
        return 0.0
    if "pole" in check.name:
        value, limit = 1.0 - limit, max(1.0 - value, 1e-12)
    elif limit - value != check.margin:  # a figure that must not be below its limit
        value, limit = limit, value
    return value / limit if limit > 0.0 else float(not check.passed)


def observations_table(gains: GainSet) -> PageTable:
    """What was observed beside the checks, told and not judged. Raises BadInput for a set without a certificate."""
    observations = {k: v for k, v in _certificate(gains).observations.items() if k not in MARGINS}
    return PageTable("Told, not judged", ("figure", "value"), tuple((k, f"{v:.4g}") for k, v in observations.items()))


def _exact(check: CertificateCheck) -> bool:
    return check.passed and abs(check.value - check.limit) <= 1e-6 * abs(check.limit)


def margin_rows(certificate: Judged) -> Iterator[tuple[str, ...]]:
    """One row for each margin that a certificate states; none of one of an earlier version."""
    observations = certificate.observations
    for key, words in MARGINS.items():
        if key in observations:
            yield words.name, f"{observations[key]:.3g}", words.unit, words.usual, words.meaning


def _certificate(gains: GainSet) -> Certificate:
    if gains.certificate is None:
        raise BadInput(f"gain set {gains.name}: certificate", "nothing", "one that `servoctl verify` wrote")
    return gains.certificate


def _verdict(passed: bool) -> str:
    return "passed" if passed else "failed"


# --- Frequency response ----------------------------------------------------------------------------------------------
# Figure of an identification's frequency response: what the multisine showed, and the model that was put to it.


_RESPONSE_POINTS = 300
#: Half width of a 95 % interval over the standard deviation.
_HALF = 1.96


def measured_response(found: ResponseFit, name: str = "frequency_response") -> Figure:
    """Position over torque command of the sliding joint, measured line by line and fitted, and the coherence."""
    fine = np.geomspace(found.frequency_hz[0], found.frequency_hz[-1], _RESPONSE_POINTS)
    gain, error, fitted = np.abs(found.response), _HALF * found.deviation, found.model(fine)
    phase, model_phase = np.degrees(found.phase_rad(found.response)), np.degrees(falling_phase_rad(fitted))
    hz = PlotAxis("frequency in Hz", ScaleKind.LOG)
    panels = (
        PlotPanel(
            hz,
            PlotAxis("position/torque in rad/(N·m)", ScaleKind.LOG),
            _panel(found, gain, (gain * (1.0 - np.minimum(error, 0.99)), gain * (1.0 + error)), fine, np.abs(fitted)),
            "gain",
        ),
        PlotPanel(
            hz,
            PlotAxis("phase in degrees"),
            _panel(found, phase, (phase - np.degrees(error), phase + np.degrees(error)), fine, model_phase),
            "phase",
        ),
        PlotPanel(hz, PlotAxis("coherence in %", span=(0.0, 105.0)), _coherence(found), "coherence"),
    )
    caption = (
        "Torque command to position while the joint slides; bars are 95 % intervals by the scatter of the strokes. "
        f"Lines with less coherence than {LEAST_COHERENCE:.0%} count for nothing."
    )
    return Figure(name, "Frequency response", panels, 3, caption)


def _panel(
    found: ResponseFit, values: Array, bounds: tuple[Array, Array], fine: Array, fitted: Array
) -> tuple[Curve, ...]:
    """The measured lines with their intervals, and the model."""
    measured = curve("measured", found.frequency_hz, values, Colour.BLUE, Style.POINTS, bounds=bounds)
    what = "two masses and a spring" if found.resonance is not None else "rigid joint"
    return measured, curve(f"fitted, {what}", fine, fitted, Colour.ORANGE)


def _coherence(found: ResponseFit) -> tuple[Curve, ...]:
    ends, least = found.frequency_hz[[0, -1]], np.full(2, 100.0 * LEAST_COHERENCE)
    line = curve("least that counts", ends, least, Colour.GREY, Style.DASHED, width=1.0)
    return curve("measured", found.frequency_hz, 100.0 * found.coherence, Colour.BLUE, Style.POINTS), line
