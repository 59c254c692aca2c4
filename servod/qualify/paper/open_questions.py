"""What the paper leaves open: the sign and size of l, the readings of Table I's gains, slips of its equations.

Stands on the sweeps; each has a figure or a row of a table, and a sentence that its numbers choose.
"""

from __future__ import annotations

from collections.abc import Iterator

from servod.lab.report.figure import COLOURS, Colour, Figure, PlotAxis, PlotPanel, ScaleKind, Style, curve
from servod.lab.report.figures.motion import errors
from servod.lab.tune.plan import Feedback
from servod.qualify.paper.claims import Claim, Shown, least
from servod.qualify.paper.equations import TwoForms
from servod.qualify.paper.experiments import LABELS
from servod.qualify.paper.joints import PaperJoint
from servod.qualify.paper.programme import ProgrammeAnswer
from servod.qualify.paper.results import Results, Row
from servod.qualify.paper.sweeps import NOISE_SHARES, SweepOfL

#: Names of the sweeps in Results.sweeps, and of the slips in Results.slips.
TABLE1_GAINS, PD_GAINS = "gains of Table I", "the paper's PD gains"
EXPONENT, LITERAL_8 = "sign of the exponent in (18)", "(8) taken literally instead of (7)"


def figures(results: Results) -> Iterator[Shown]:
    """Sweep of l, both readings of the gains, errors over the noise on friction."""
    yield Shown("Table I, K_i", _sweep_figure(results), tuple(_sweep_claims(results)))
    for joint in results.found:
        pair = (results.measured[joint, row].followed for row in (Row.TABLE1, Row.TABLE1_OTHER))
        shown = [motion for motion in pair if motion is not None]
        if shown:
            title = f"Both readings of Table I's gains on {joint.label}"
            figure = errors(shown, f"table1_readings_{joint.value}", title)
            yield Shown("Table I, gains", figure, tuple(_readings(results, joint)), joint.label)
    yield Shown("11", _noise_figure(results), (_noise_claim(results),))


def statements(results: Results) -> Iterator[tuple[str, Claim]]:
    """Claims without a figure, each with what it is about."""
    yield from (("equations", claim) for claim in _equations(results))
    yield from (("rivals", claim) for joint in results.tuned for claim in _rivals(results, joint))


def _rivals(results: Results, joint: PaperJoint) -> Iterator[Claim]:
    """The paper's order once every law is tuned by the same rules, in both classes."""
    for feedback in Feedback:
        found = {
            c.law: t.rms_error_mrad
            for c in results.tuned[joint]
            if c.feedback is feedback and (t := c.measured.tracking()) is not None
        }
        paper = (
            f"the local law tracks best, every law tuned by the same rules, {feedback.value} feedback, {joint.label}"
        )
        if LABELS["local"] in found:
            yield least(LABELS["local"], found, paper)
        else:
            yield Claim(paper, "the axis stopped under the local law", False)


def _equations(results: Results) -> Iterator[Claim]:
    """Printed against consistent equations: what the form costs on (19), and what the programme's answer is worth."""
    for name, forms in results.slips.items():
        serves = forms.printed_mrad <= forms.consistent_mrad
        yield Claim(f"{name}: the printed form serves as well", _slip(forms), serves)
    for answer in results.programme:
        paper = f"(14) over (15) in the {answer.form} form, l_i {answer.l_i:g}, gives a stable feedback"
        stable = answer.largest_pole is not None and answer.largest_pole < 1.0
        yield Claim(paper, _programme(answer), stable)


def _programme(answer: ProgrammeAnswer) -> str:
    """Both regions' feedback or clashes, and the sampled loop."""
    clauses = []
    for name, region in answer.regions.items():
        if region.position_nm_per_rad is None:
            clauses.append(f"no feedback in region {'; '.join(region.clashes)}")
        else:
            gains = f"{region.position_nm_per_rad:.4g} N·m/rad and {region.velocity_nms_per_rad:.4g} N·m·s/rad"
            clauses.append(f"region {name} {gains}")
    if answer.largest_pole is not None:
        clauses.append(f"the largest pole of the sampled loop is {answer.largest_pole:.3g}")
        clauses.append(f"(19) with {answer.rms_mrad:.4g} mrad RMS")
    return ", ".join(clauses)


def _slip(forms: TwoForms) -> str:
    speeds = ", ".join(
        f"{1e3 * p:.4g} against {1e3 * c:.4g} at {v:g}"
        for v, p, c in zip(forms.speeds, forms.printed_nm, forms.consistent_nm, strict=True)
    )
    return (
        f"(19) is tracked with {forms.printed_mrad:.4g} mrad RMS as printed and {forms.consistent_mrad:.4g} in the "
        f"consistent form; friction in mN·m, printed against consistent: {speeds} rad/s"
    )


def _sweep_figure(results: Results) -> Figure:
    panels = []
    for name, sweep in results.sweeps.items():
        curves = [
            curve(sign, sweep.factors, rms, colour, style, 1.6)
            for (sign, rms), colour, style in zip(
                sweep.rms_mrad.items(), COLOURS, (Style.LINE, Style.DASHED, Style.DOTTED), strict=False
            )
        ]
        ends = [sweep.factors[0], sweep.factors[-1]]
        curves.append(curve("l = 0", ends, [sweep.without] * 2, Colour.BLACK, width=1.0))
        x = PlotAxis("l_i as a multiple of the printed K_i", ScaleKind.LOG)
        panels.append(PlotPanel(x, PlotAxis("RMS error on (19) in mrad", ScaleKind.LOG), tuple(curves), name))
    return Figure("table1_sweep_of_l", "Sign and size of l", tuple(panels), len(panels), row_height=1.4)


def _sweep_claims(results: Results) -> Iterator[Claim]:
    for name, sweep in results.sweeps.items():
        best, factor, rms = _best(sweep)
        printed = sweep.rms_mrad["signs as printed"][-1]
        here = f"with {name}, as printed {printed:.4g} mrad RMS, without l {sweep.without:.4g}"
        yield Claim("the printed K_i, read as l_i, serve", here, printed < sweep.without)
        where = f"at {factor:.3g} times K_i ({best})"
        here = f"with {name}, the least is {rms:.4g} mrad {where}, without l {sweep.without:.4g}"
        yield Claim("l_i can improve the tracking", here, rms < sweep.without)


def _best(sweep: SweepOfL) -> tuple[str, float, float]:
    """(sign, factor, RMS) of the least error."""
    rows = [(s, f, r) for s, values in sweep.rms_mrad.items() for f, r in zip(sweep.factors, values, strict=True)]
    return min(rows, key=lambda row: row[2])


def _readings(results: Results, joint: PaperJoint) -> Iterator[Claim]:
    for row, reading in ((Row.TABLE1, "(K_z, K_v, K_x)"), (Row.TABLE1_OTHER, "(K_x, K_v, K_z)")):
        rms = results.rms(joint, row)
        paper = f"{row.paper_mrad} mrad RMS with the gains of Table I, read as {reading}"
        if rms is None or row.paper_mrad is None:
            yield Claim(paper, f"{joint.label} is stopped", False)
        else:
            yield Claim(paper, f"{rms:.4g} mrad RMS on {joint.label}", rms <= row.paper_mrad)


def _noise_claim(results: Results) -> Claim:
    """The proposed law against the rivals with the same noise."""
    last = {label: rms[-1] for label, rms in results.noise.items()}
    return least(Row.TABLE1.label, last, f"with noise of {NOISE_SHARES[-1]:.0%} of F_C the proposed law does best")


def _noise_figure(results: Results) -> Figure:
    shares = [0.0, *(100.0 * share for share in NOISE_SHARES)]
    curves = [
        curve(label, shares, rms, colour, style, 1.6)
        for i, (label, rms) in enumerate(results.noise.items())
        for colour, style in ((COLOURS[i % len(COLOURS)], Style.LINE if i % 2 == 0 else Style.DASHED),)
    ]
    panel = PlotPanel(
        PlotAxis("RMS of the noise on friction in % of F_C"),
        PlotAxis("RMS error on (19) in mrad", ScaleKind.LOG),
        tuple(curves),
    )
    return Figure("figure_11_errors_over_noise", "Errors over the noise on friction", (panel,), row_height=1.4)
