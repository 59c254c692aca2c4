"""The whole of a scored trial as one JSON document, and its files: prove.json, prove.md, prove.html, pictures.

The end of the third process. prove.json comes last, so that a folder with it is whole.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from servod.common.errors import BadInput
from servod.common.report_files import write_bytes
from servod.lab.report.page import Page
from servod.qualify.blind import count, figures, tables
from servod.qualify.blind.conceal import SEALED, TRUTH, read_truth
from servod.qualify.blind.examine import ANSWERS, RUN, one_diagnosis
from servod.qualify.blind.plan import Sort
from servod.qualify.blind.score import Scored, score_case
from servod.qualify.blind.trial import Trial

#: Told how many cases are scored of how many.
Tell = Callable[[int, int], None]

PICTURES = "pictures"


def score(trial: Trial, out: Path, tell: Tell) -> dict[str, Any]:
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
        tell(number + 1, len(truth))
    return document(trial, cases)


def document(trial: Trial, cases: list[Scored]) -> dict[str, Any]:
    """The JSON document."""
    concealed = [case for case in cases if case.sort in (Sort.SINGLE, Sort.PAIR)]
    alarmed = [case for case in cases if case.sort is Sort.NOTHING and case.guesses]
    return {
        "version": trial.version,
        "sources": next((case.run["sources"] for case in cases if case.run), None),
        "cases": trial.cases,
        "seed": trial.seed,
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
            {"effect": p.effect, "name": p.name, "error": round(p.error, 5), "covered": p.covered, "told": p.told}
            for p in case.parameters
        ],
        "held_out_rad": {key: None if math.isnan(value) else value for key, value in held.items()},
        **case.run,
    }


def write(found: dict[str, Any], out: Path) -> None:
    """Pictures, Markdown, page and JSON into `out`. Raises BadInput when they cannot be written."""
    drawn: list[figures.Matrix | figures.Drawn] = [figures.confusion(found), figures.calibration(found)]
    for picture in drawn:
        picture.write(out / PICTURES)
    write_bytes(out / "prove.md", tables.markdown(found).encode())
    page = Page("A blind trial of the diagnosis")
    for sentence in tables.sentences(found):
        page.sentence(sentence)
    for table in tables.all_tables(found):
        page.heading(table.title)
        page.table(table.header, table.rows)
        for picture in drawn:
            if picture.beside == table.title:
                page.figure(picture.plotly())
                page.sentence(picture.caption)
    page.write(out / "prove.html")
    write_bytes(out / "prove.json", (json.dumps(found, indent=1, allow_nan=False) + "\n").encode())
