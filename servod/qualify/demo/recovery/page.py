"""The page of `servoctl demo --diagnose`: what was believed, what came, what was found, and what that gave back.

The last step of `walk`; the diagnosis has its own page beside it.
"""

from __future__ import annotations

from pathlib import Path

from servod.lab.diagnose.document import describe_certainty
from servod.lab.report.diagnosis import Report
from servod.lab.report.figure import Axis, Colour, Curve, Figure, Panel, curve
from servod.lab.report.figures import mismatch
from servod.lab.report.figures.signature import signature_figure
from servod.lab.tracking.metrics import SETTLE_S
from servod.qualify.demo.recovery.walk import DIAGNOSIS, Recovery, error_mrad, time_s, within

#: Runs as people read them, with their colours.
RUNS = {
    "before": ("as believed", Colour.BLACK),
    "concealed": ("with the effect concealed", Colour.ORANGE),
    "after": ("after diagnosis and new design", Colour.BLUE),
}


def write_recovery_page(found: Recovery, out: Path) -> Path:
    """Write `report.html` and pictures into `out`. Raises BadInput when that is not possible."""
    report = Report(out, "servod demo: an axis that conceals something")
    rms, page = found.rms_mrad, report.page
    back = min(100.0 * found.recovered_share, 100.0)
    page.lead(
        f"{back:.0f} % of what the concealed effect cost is back: {rms['before']:.3f} mrad "
        f"RMS on trajectory (19) as believed, {rms['concealed']:.3f} with it, {rms['after']:.3f} once it is known."
    )
    page.points(story(found))
    report.figure(_errors(found))
    _figures(report, found)
    page.heading("What the diagnosis found in the axis's own recordings")
    page.points([f["statement"] for f in found.document["findings"]])
    page.points([line for f in found.document["findings"] for line in describe_certainty(f)])
    evidence, units = found.diagnosis.evidence, found.diagnosis.units
    if evidence is not None:
        report.figure(mismatch.where(evidence.maps_before, units))
        terms = [(one, named.effect) for named in evidence.findings for one in named.signatures]
        for one, effect in sorted(terms, key=lambda term: term[0].number):
            report.figure(signature_figure(one, effect, units))
    page.sentence(f"All of it: {DIAGNOSIS}/report.html, {DIAGNOSIS}/diagnosis.json and {DIAGNOSIS}/model.yaml.")
    return report.write()


def story(found: Recovery) -> list[str]:
    """What happened, a sentence for each step."""
    name = found.effect.replace("_", " ")
    named = ", ".join(f["effect"].replace("_", " ") for f in found.document["findings"]) or "nothing by name"
    stays = "was deployed" if found.deployment.proven else f"was rolled back ({'; '.join(found.deployment.reasons)})"
    return [
        f"A controller was designed and certified for what is believed of the axis, {within(found.first.scale)}.",
        f"The axis has {name} that nobody told the controller of: {_kept(found)}.",
        f"The axis's own recordings were diagnosed: {named}.",
        f"A controller designed and certified for the extended model, {within(found.second.scale)}, {stays}.",
    ]


def _kept(found: Recovery) -> str:
    """Whether the axis did what the first certificate promised."""
    if found.broken_promises:
        return f"it tracks worse than the certificate promised ({'; '.join(found.broken_promises)})"
    times = found.rms_mrad["concealed"] / found.rms_mrad["before"]
    return (
        "of the validation motion it does what the certificate promised all the same, and the error on trajectory (19) "
        f"is {times:.2g} times as large"
    )


def _errors(found: Recovery) -> Figure:
    """The three errors on trajectory (19), over each other."""
    runs = {"before": found.before, "concealed": found.concealed, "after": found.after}
    curves: list[Curve] = []
    for key in ("concealed", "before", "after"):
        label, colour = RUNS[key]
        late = time_s(runs[key]) >= SETTLE_S
        curves.append(curve(label, time_s(runs[key])[late], error_mrad(runs[key])[late], colour, width=1.1))
    panel = Panel(Axis("time in s"), Axis("error in mrad"), tuple(curves))
    caption = "Reference minus encoder position on trajectory (19), without its first second."
    return Figure("recovery", "Tracking before, with and after", (panel,), 1, caption, 1.3)


def _figures(report: Report, found: Recovery) -> None:
    """What certificates promised of the validation motion, and what came."""
    first, done = found.first.promised_mrad, found.deployment.document()
    after = done["after"] or {}
    rows = [
        (
            key.removesuffix("_mrad"), f"{first.get(key, 0.0):.4g}", f"{value:.4g}",
            f"{done['promised'][key]:.4g}", f"{after[key]:.4g}" if key in after else "none",
        )
        for key, value in done["before"].items()
        if key in done["promised"] and isinstance(value, float)
    ]  # fmt: skip
    report.page.sentence("The validation motion, RMS error in mrad: what the certificates promised, and what came.")
    report.page.table(("part", "promised at first", "came", "promised anew", "came then"), rows)
