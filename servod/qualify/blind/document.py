"""The whole of a scored trial as one JSON document, and its files: prove.json, prove.md, prove.html, pictures.

The end of the third process. prove.json comes last, so that a folder with it is whole.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.common.files import write_bytes
from servod.common.progress import OnCount
from servod.lab.report.figure import Colour, Figure, PageTable, PlotAxis, PlotPanel, Style, curve
from servod.lab.report.page import Page, Verdict, table_html
from servod.lab.report.pictures import write_pictures
from servod.qualify.blind import count, tables
from servod.qualify.blind.conceal import SEALED, TRUTH, BlindTrial, read_truth
from servod.qualify.blind.examine import ANSWERS, RUN, one_diagnosis
from servod.qualify.blind.plan import Sort
from servod.qualify.blind.score import Scored, score_case
from servod.qualify.blind.tables import CONFIDENCE, EFFECTS

# --- Pictures --------------------------------------------------------------------------------------------------------
# The pictures of a trial: who was taken for whom, and whether stated confidence is to be believed. Drawn from the JSON
# document, for the page and with matplotlib as PNG, both the same.


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Matrix:
    """A matrix of shares by row, with the counts written into its cells."""

    name: str
    title: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    counts: Array
    caption: str
    beside: str

    @property
    def shares(self) -> Array:
        """Counts over the sum of their row."""
        return np.asarray(self.counts / np.maximum(self.counts.sum(axis=1, keepdims=True), 1.0))

    def add_to(self, page: Page) -> None:
        """Into the page: a table of counts, its cells coloured by their share of the row."""
        written = [[f"{n:.0f}" if n else "" for n in row] for row in self.counts]
        rows = tuple((name, *cells) for name, cells in zip(self.rows, written, strict=True))
        shades = [[math.ceil(3.0 * share) for share in row] for row in self.shares]
        table = PageTable(self.title, ("concealed \\ answer", *self.columns), rows)
        page.html_part(table_html(table, shades=shades))
        page.sentence(self.caption)

    def write(self, folder: Path) -> None:
        """As PNG, for documents. Raises BadInput."""
        with matplotlib.rc_context({"font.size": 8, "savefig.dpi": 160}):
            canvas = Canvas(figsize=(2.5 + 0.32 * len(self.columns), 2.2 + 0.26 * len(self.rows)), layout="constrained")
            FigureCanvasAgg(canvas)
            axes = canvas.subplots()
            axes.imshow(self.shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
            axes.set_xticks(range(len(self.columns)), self.columns, rotation=60, ha="right", rotation_mode="anchor")
            axes.set_yticks(range(len(self.rows)), self.rows)
            axes.set_xlabel("answer")
            axes.set_ylabel("concealed")
            for (row, column), count in np.ndenumerate(self.counts):
                if count:
                    colour = "white" if self.shares[row, column] > 0.5 else "black"
                    axes.text(column, row, f"{count:.0f}", ha="center", va="center", color=colour)
            canvas.suptitle(self.title)
            out = io.BytesIO()
            canvas.savefig(out, format="png", metadata={"Software": None})
        write_bytes(folder / f"{self.name}.png", out.getvalue())


@dataclass(frozen=True)
class Drawn:
    """A figure of the project's own kind."""

    figure: Figure
    beside: str

    def add_to(self, page: Page) -> None:
        """Into the page."""
        page.figure(self.figure)

    def write(self, folder: Path) -> None:
        """As PNG, for documents. Raises BadInput."""
        write_pictures(self.figure, folder, ("png",))


def confusion(found: Mapping[str, Any]) -> Matrix:
    """Concealed against answered, of all cases."""
    table: Mapping[str, Mapping[str, int]] = found["confusion"]
    rows = tuple(table)
    answered = {answer for row in table.values() for answer in row}
    columns = (*(row for row in rows if row in answered), *sorted(answered - set(rows)))
    counts = np.array([[float(table[row].get(column, 0)) for column in columns] for row in rows])
    caption = "Rows: what was concealed, each effect of a pair by itself; columns: what the answer says. On the "
    caption += "diagonal it was named; `adequate` is what was missed."
    return Matrix(
        "confusion", "What was taken for what", rows, columns, counts.reshape(len(rows), -1), caption, EFFECTS
    )


def calibration(found: Mapping[str, Any]) -> Drawn:
    """Stated confidence against the share of findings that are right."""
    bins = [part for part in found["calibration"] if part["cases"]]
    stated = np.array([part["stated"] for part in bins], dtype=np.float64)
    right = np.array([part["share"] for part in bins], dtype=np.float64)
    low, high = (np.array([part["interval"][i] for part in bins], dtype=np.float64) for i in (0, 1))
    curves = (
        curve("as good as stated", [0.0, 1.0], [0.0, 1.0], Colour.GREY, Style.DASHED),
        curve("findings", stated, right, Colour.BLUE, Style.POINTS, bounds=(low, high)),
    )
    panel = PlotPanel(
        PlotAxis("stated confidence", span=(0.0, 1.02)), PlotAxis("share that is right", span=(0.0, 1.02)), curves
    )
    caption = (
        "Each point is a bin of findings with the 95 % interval of its share; on the line, confidence is calibrated."
    )
    return Drawn(Figure("calibration", "Is a stated confidence to be believed?", (panel,), caption=caption), CONFIDENCE)


PICTURES = "pictures"


def score(trial: BlindTrial, out: Path, on_progress: OnCount) -> dict[str, Any]:
    """Open the seal of the trial in `out` and score all answers.

    Raises BadInput when it is not what was sealed, or when not all answers are of one diagnosis.
    """
    try:
        truth = read_truth(out, trial.sha256)
    except (OSError, ValueError) as error:
        raise BadInput(str(out / SEALED / TRUTH), str(error), "the truth as it was sealed") from None
    one_diagnosis(out, [name for name in sorted(truth) if (out / ANSWERS / name / RUN).exists()])
    cases = []
    for number, (name, true) in enumerate(sorted(truth.items())):
        cases.append(score_case(out, name, true))
        on_progress(number + 1, len(truth))
    return document(trial, cases)


def document(trial: BlindTrial, cases: list[Scored]) -> dict[str, Any]:
    """The JSON document."""
    concealed = [case for case in cases if case.sort in (Sort.SINGLE, Sort.PAIR)]
    alarmed = [case for case in cases if case.sort is Sort.NOTHING and case.guesses]
    return {
        "version": trial.version,
        "sources": next((case.run["sources"] for case in cases if case.run), None),
        "cases": trial.cases,
        "seed": trial.seed,
        "null": trial.null,
        "engine": trial.engine,
        "harder": trial.harder,
        "sha256": trial.sha256,
        "table": count.shares(cases, lambda case: case.sort.value),
        "by_effect": count.by_effect(cases),
        "by_cover": count.shares(concealed, lambda case: case.truth["cover"]),
        "by_form": count.shares(concealed, lambda case: "other" if case.truth["forms"] else "textbook"),
        "by_joint": count.shares(cases, lambda case: case.truth["joint"]),
        "unexplained": _unexplained(cases),
        "false_alarms": {case.name: [guess.effect for guess in case.guesses] for case in alarmed},
        "confusion": count.confusion(cases),
        "parameters": count.parameters(cases),
        "calibration": count.calibration(cases),
        "held_out": count.held_out(cases),
        "times": count.times(cases),
        "results": [_row(case) for case in cases],
    }


def _unexplained(cases: list[Scored]) -> dict[str, Any]:
    """Of physics on nobody's list: how often it was found at all."""
    unknown = [case for case in cases if case.sort is Sort.UNKNOWN]
    return count.share(sum(case.verdict == "unexplained" for case in unknown), len(unknown))


def _row(case: Scored) -> dict[str, Any]:
    """One case, in short."""
    held = {"before": case.held_out.before, "after": case.held_out.after, "true": case.held_out.own}
    return {
        "case": case.name,
        "sort": case.sort.value,
        "concealed": [case.truth["unknown"]] if case.sort is Sort.UNKNOWN else case.truth["effects"],
        "joint": case.truth["joint"],
        "cover": case.truth["cover"],
        "other_form": case.truth["forms"],
        "strength": case.truth["strength"],
        "verdict": case.verdict,
        "named": {guess.effect: guess.confidence for guess in case.guesses},
        "right": case.right,
        "parameters": [
            {"effect": p.effect, "name": p.name, "error": round(p.error, 5), "covered": p.covered, "told": p.reported}
            for p in case.parameters
        ],
        "held_out_rad": {key: None if math.isnan(value) else value for key, value in held.items()},
        **case.run,
    }


def write(found: dict[str, Any], out: Path) -> None:
    """Pictures, Markdown, page and JSON into `out`. Raises BadInput when they cannot be written."""
    drawn: list[Matrix | Drawn] = [confusion(found), calibration(found)]
    for picture in drawn:
        picture.write(out / PICTURES)
    write_bytes(out / "prove.md", tables.markdown(found).encode())
    page = Page("A blind trial of the diagnosis", Verdict(tables.verdict(found)))
    for sentence in tables.sentences(found):
        page.sentence(sentence)
    for table in tables.all_tables(found):
        page.heading(table.title)
        page.table(table)
        for picture in drawn:
            if picture.beside == table.title:
                picture.add_to(page)
    page.write(out / "prove.html")
    write_bytes(out / "prove.json", (json.dumps(found, indent=1, allow_nan=False) + "\n").encode())
