"""The page of a diagnosis and its pictures: plain sentences first, where before what, mathematics folded behind.

Stands on the result of a diagnosis and on its document, whose numbers it shows; nothing is decided here.
"""

from __future__ import annotations

import json
from pathlib import Path
from time import monotonic
from typing import Any

from servod.common.files import write_bytes
from servod.formats.model.axis_model import axis_model_yaml
from servod.lab.diagnose.document import (
    MATHEMATICS,
    REMEDIES,
    describe_certainty,
    describe_fit,
    describe_rest,
    diagnosis_document,
    next_experiments,
    verdict_sentence,
)
from servod.lab.diagnose.explain import explain_effect
from servod.lab.diagnose.result import Diagnosis, DiagnosisVerdict, Evidence, Units
from servod.lab.report.figure import Figure, PageTable
from servod.lab.report.figures import mismatch as figures
from servod.lab.report.figures.signature import signature_figure, table_figure
from servod.lab.report.page import Origin, Page, Verdict
from servod.lab.report.pictures import write_pictures

Document = dict[str, Any]

#: Names of page and folder of pictures beside diagnosis.json.
PAGE, PICTURES = "report.html", "pictures"


class DiagnosisReport:
    """The page in the making; every figure is written as PNG too."""

    def __init__(self, folder: Path, title: str, verdict: Verdict, origin: Origin | None = None) -> None:
        self.page, self._pictures = Page(title, verdict, origin), folder / PICTURES
        self._path = folder / PAGE

    def figure(self, shown: Figure) -> None:
        """Add a figure with its caption, and write its picture. Raises BadInput when that is not possible."""
        self.page.figure(shown)
        write_pictures(shown, self._pictures, ("png",))

    def write(self) -> Path:
        """Write the page. Raises BadInput when that is not possible."""
        self.page.write(self._path)
        return self._path


#: Whether a verdict says that the model may stay as it is; what cannot be told is neither.
_PASSED = {DiagnosisVerdict.ADEQUATE: True, DiagnosisVerdict.CANNOT_TELL: False}


def write_report(
    folder: Path, diagnosis: Diagnosis, document: Document, title: str = "the model", origin: Origin | None = None
) -> Path:
    """Write `report.html` and `pictures/*.png` into `folder`; `document` is that of the diagnosis."""
    verdict = Verdict(verdict_sentence(document), _PASSED.get(diagnosis.verdict))
    report = DiagnosisReport(folder, f"Diagnosis: what {title} leaves out", verdict, origin)
    _answer(report.page, document)
    if diagnosis.evidence is not None:
        _where(report, diagnosis.evidence, diagnosis.units)
        _what(report, diagnosis.evidence, document, diagnosis.units)
        _fit(report, diagnosis.evidence, document, diagnosis.units)
        _remains(report, diagnosis.evidence, document, diagnosis.units)
    _experiments(report.page, document)
    _recordings(report.page, document)
    _work(report.page, document)
    return report.write()


def _answer(page: Page, document: Document) -> None:
    """What was left out, how sure: everything that fits into a few sentences."""
    page.points([f["statement"] for f in document["findings"]])
    page.points([line for f in document["findings"] for line in describe_certainty(f)])


def _where(report: DiagnosisReport, evidence: Evidence, units: Units) -> None:
    report.page.heading("Where the model is off")
    report.page.sentence(
        "Before any physics is named: the model's own parameters were fitted to the recordings, and what it still "
        "gets wrong is looked at, as a torque in every row, over everything that the axis did."
    )
    report.figure(figures.where(evidence.maps_before, units))
    band = evidence.bands
    report.page.sentence(
        f"By frequency: {100.0 * max(band['shares']):.0f} % of it lies between {band['from']:g} and {band['to']:g} Hz."
    )


def _what(report: DiagnosisReport, evidence: Evidence, document: Document, units: Units) -> None:
    for number, (found, finding) in enumerate(zip(evidence.findings, document["findings"], strict=True), 1):
        report.page.heading(f"Finding {number}: {finding['effect'].replace('_', ' ')}")
        report.page.sentence(finding["statement"])
        for one in found.signatures:
            report.figure(signature_figure(one, found.effect, units))
        _parameters(report.page, finding["parameters"])
        report.page.points(describe_certainty(finding))
        known = explain_effect(finding["effect"])
        keys = [f"{key['key']}: {key['meaning']} ({key['range']})" for key in known["keys"]]
        report.page.folded(
            "The mathematics of this finding",
            [f"Equation: {known['equation']}.", f"Source: {known['source']}.", "Keys in the axis model file:", *keys],
        )
    for part in document.get("partial", {"effects": []})["effects"]:
        report.page.heading(f"Part of the answer: {part['effect'].replace('_', ' ')}")
        report.page.sentence(
            f"It takes {100.0 * part['share']:.0f} % of the explainable mismatch on rows that the fit has not seen; "
            "what is left beside it has no name, and may change it."
        )
        _parameters(report.page, part["parameters"])
    if evidence.residual is not None:
        report.page.heading("What is left has no name")
        report.figure(table_figure(evidence.residual, units))
    _recalibrated(report.page, document)


def _parameters(page: Page, parameters: Document) -> None:
    rows = [
        (name, f"{v['value']:.5g}", f"{v['interval'][0]:.4g} to {v['interval'][1]:.4g}", v["unit"])
        for name, v in parameters.items()
    ]
    page.table(PageTable("Parameters", ("parameter", "value", "95 % interval", "unit"), tuple(rows)))


def _recalibrated(page: Page, document: Document) -> None:
    """Own parameters that were off by little, and effects that are there but small."""
    if document["recalibrated"]:
        page.heading("Parameters that were merely off")
        rows = [
            (name, f"{v['from']:.5g}", f"{v['to']:.5g}", f"{v['interval'][0]:.4g} to {v['interval'][1]:.4g}", v["unit"])
            for name, v in document["recalibrated"].items()
        ]
        header = ("parameter", "model", "fitted", "95 % interval", "unit")
        page.table(PageTable("Recalibrated", header, tuple(rows)))
    if document["minor"]:
        small = "; ".join(_small(name, size) for name, size in document["minor"].items())
        page.sentence(f"Seen, but no finding: {small}. Every real axis has some.")


def _small(name: str, size: Document) -> str:
    """An effect that is no finding: how large, and what it is if it stands in the model all the same."""
    torque = f"{100.0 * size['torque_over_coulomb']:.1f} % of dry friction"
    if "why" not in size:
        return f"{name.replace('_', ' ')} ({torque}, too small to be worth a name)"
    values = ", ".join(f"{key} {value['value']:.3g} {value['unit']}" for key, value in size["parameters"].items())
    return f"{name.replace('_', ' ')} ({torque}, {size['why']}; in the model with {values})"


def _fit(report: DiagnosisReport, evidence: Evidence, document: Document, units: Units) -> None:
    fit, held = document["fit"], document["fit"]["held_out"]
    report.page.heading("The fit before and after")
    report.page.sentence(describe_fit(document))
    if held["not_judged_s"]:
        report.page.sentence(
            f"Errors leave out {held['not_judged_s']:.2g} s in and behind an external torque that came once: nothing "
            "predicts it. The share that it carries is that of the fit itself."
        )
    rows = [
        (f"{horizon} s", f"{w['before']:.4g}", f"{w['recalibrated']:.4g}", f"{w['after']:.4g}", w["unit"])
        for horizon, w in fit["windows"].items()
    ]
    header = ("simulated freely for", "model as it came", "recalibrated only", "with what was found", "unit")
    report.page.table(PageTable("Position errors", header, tuple(rows)))
    _held_out(report.page, document)
    torque = {r["name"]: (r["mismatch_before"], r["mismatch_after"]) for r in document["recordings"] if r["taken"]}
    panels = [figures.before_after(torque, units.force, "torque error")]
    for horizon, window in fit["windows"].items():
        errors = {name: (w["before"], w["after"]) for name, w in window["recordings"].items()}
        panels.append(figures.before_after(errors, units.length, f"position after {horizon} s", named=False))
    report.figure(figures.bars(panels, evidence.quality.left_out))
    report.figure(figures.over_time(evidence.recordings, units))


def _held_out(page: Page, document: Document) -> None:
    """Recordings that no fit has seen."""
    rows = [
        (name, f"{horizon} s", f"{w['before']:.4g}", f"{w['after']:.4g}", f"{w['coasting']:.4g}", w["unit"])
        for name, windows in document.get("held_out", {}).items()
        for horizon, w in windows.items()
    ]
    if rows:
        header = ("held out", "simulated freely for", "model as it came", "model.yaml", "going on at its speed", "unit")
        page.table(PageTable("Recordings that no fit has seen", header, tuple(rows)))


def _remains(report: DiagnosisReport, evidence: Evidence, document: Document, units: Units) -> None:
    report.page.heading("What remains")
    report.page.sentence(describe_rest(document))
    report.figure(figures.map_grid(evidence.maps_before, evidence.maps_after, units))
    report.figure(figures.spectrum(evidence.quality.spectrum_before, evidence.quality.spectrum_after, units))
    if evidence.quality.windows:
        report.figure(figures.window_course(evidence.quality.windows, evidence.quality.left_out, units))


def _experiments(page: Page, document: Document) -> None:
    lines = next_experiments(document)
    if lines:
        page.heading("Which experiment next")
        page.points(lines)


def _recordings(page: Page, document: Document) -> None:
    """What was taken in, repaired and refused."""
    page.heading("The recordings")
    force, length = document["units"]["torque"], document["units"]["position"]
    rows = [
        (
            r["name"], f"{r['duration_s']:.2f}", f"{1.0 / r['period_s']:.0f}", f"{r['rows']}",
            f"{r['position_noise']:.2g}", f"{r['noise_floor']:.2g}",
        )
        for r in document["recordings"]
        if r["taken"]
    ]  # fmt: skip
    if rows:
        header = ("recording", "length / s", "rate / Hz", "rows compared", f"encoder noise / {length}")
        page.table(PageTable("What was compared", (*header, f"noise floor / {force}"), tuple(rows)))
    repaired = [f"{r['name']}: {note}." for r in document["recordings"] if r["taken"] for note in r["notes"]]
    refused = [f"{r['name']} was not used: {r['reason']}." for r in document["recordings"] if not r["taken"]]
    page.points([*refused, *repaired] or ["Nothing had to be repaired or refused."])
    if refused:
        page.points(sorted({REMEDIES[word] for word in REMEDIES for line in refused if word in line}))


def _work(page: Page, document: Document) -> None:
    """How it was found, folded."""
    page.folded("How it was found", MATHEMATICS)
    spent = [f"{stage}: {seconds:.1f} s" for stage, seconds in document["seconds"].items()]
    page.folded("Time by stage", spent)


# --- The folder of a diagnosis ---------------------------------------------------------------------------------------
# Writes what a diagnosis leaves in its folder: diagnosis.json, model.yaml, report.html and the pictures. Every file is
# written aside and renamed.


#: Names of the files of the outside contract.
DOCUMENT, MODEL = "diagnosis.json", "model.yaml"


def write_files(folder: Path, diagnosis: Diagnosis, title: str, origin: Origin | None = None) -> dict[str, Any]:
    """Write all files into `folder` and return the document. Without an answer there is no model. Raises BadInput.

    `origin` is what the page states as its sources.
    """
    begun = monotonic()
    document = diagnosis_document(diagnosis)
    if diagnosis.evidence is None:
        (folder / MODEL).unlink(missing_ok=True)
    else:
        write_bytes(folder / MODEL, axis_model_yaml(diagnosis.evidence.model).encode())
    write_report(folder, diagnosis, document, title, origin)
    document["seconds"]["report"] = round(monotonic() - begun, 2)
    write_bytes(folder / DOCUMENT, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    return document
