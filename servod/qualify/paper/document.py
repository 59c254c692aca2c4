"""The files of a run: paper.json, paper.md, paper.html, and pictures as PNG and SVG.

Stands on results, figures and tables. Every file is written aside and renamed; paper.json comes last, so that a folder
with it is whole.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from servod import __version__
from servod.common.files import write_bytes
from servod.formats.gains.parameters import LocalParameters
from servod.lab.report.figure import PageTable
from servod.lab.report.page import Page, Verdict
from servod.qualify.paper import friction, loops, motions, open_questions, table
from servod.qualify.paper.claims import Claim, Shown
from servod.qualify.paper.experiments import Found, Measured
from servod.qualify.paper.joints import PaperJoint
from servod.qualify.paper.results import Results, Row

#: Folder of the pictures below the run's.
PICTURES = "pictures"
_TITLE = "The paper from this software"
_NOTE = (
    "Robust Tracking Controller Design With Uncertain Friction Compensation Based on a Local Modeling Approach, its "
    "figures and numbers from servod on a virtual axis. The paper's figures are its laboratory joint's; ours are a "
    "simulated joint's. Whether a statement of the paper holds here is decided by the numbers of this run."
)


def shown(results: Results) -> list[Shown]:
    """All figures with their claims, in the paper's order."""
    parts: Iterator[Shown] = (s for part in (friction, loops, motions, open_questions) for s in part.figures(results))
    return sorted(parts, key=lambda s: int(s.number.split(",")[0]) if s.number[0].isdigit() else 99)


def document(results: Results, figures: Sequence[Shown], elapsed_s: float) -> dict[str, Any]:
    """The JSON document: everything but curves and pictures."""
    return {
        "version": __version__,
        "seed": results.seed,
        "seconds": results.seconds,
        "elapsed_s": elapsed_s,
        "joints": {joint.value: _joint(results, joint) for joint in results.found},
        "sweep_of_l": {name: asdict(sweep) for name, sweep in results.sweeps.items()},
        "noise_on_friction": results.noise,
        "figures": [s.document() for s in figures],
        "programme": [asdict(answer) for answer in results.programme],
        "statements": [{"about": about, **asdict(claim)} for about, claim in open_questions.statements(results)],
    }


def _joint(results: Results, joint: PaperJoint) -> dict[str, Any]:
    found = results.found[joint]
    identified = found.model.identified
    return {
        "identified": {k: v.model_dump() for k, v in identified.values.items()} if identified else {},
        "feedback": _feedback(found),
        "tracking": {row.name.lower(): tracking_of(results.measured[joint, row]) for row in Row},
        "tuned": [
            {"law": t.law, "feedback": t.feedback.value, **tracking_of(t.measured)}
            for t in results.tuned.get(joint, [])
        ],
    }


def _feedback(found: Found) -> dict[str, dict[str, float]]:
    """Synthesized feedback per region in N*m/rad and N*m*s/rad, as it is once the commands it remembers are steady."""
    law = found.gains.parameters
    assert isinstance(law, LocalParameters)
    return {
        name: {
            "position_nm_per_rad": law.input_scale_nm * gains.k_x_per_rad / (1.0 + sum(gains.k_u or ())),
            "velocity_nms_per_rad": law.input_scale_nm * gains.k_v_s_per_rad / (1.0 + sum(gains.k_u or ())),
        }
        for name, gains in (("low", law.regions.low), ("high", law.regions.high))
    }


def tracking_of(measured: Measured) -> dict[str, Any]:
    """What one controller did, plain; null where the axis stopped, and `stops` says by which fault."""
    tracked = measured.tracking()
    none: dict[str, Any] = dict.fromkeys(("rms_error_mrad", "max_error_mrad", "roughness_nm"))
    steps = {f"{size:g}": response.document() for size, response in measured.responses.items()}
    whole = none if tracked is None else tracked.document()
    return {**whole, "steps": steps, "stops": measured.stops}


def tables(found: dict[str, Any]) -> list[PageTable]:
    """All tables of a document, the paper's numbers first."""
    joints = [PaperJoint(name) for name in found["joints"]]
    tuned = [table.tuned(found, joint) for joint in joints if found["joints"][joint.value]["tuned"]]
    return [table.numbers(found), *tuned, *(table.steps(found, joint) for joint in joints)]


def markdown(found: dict[str, Any]) -> str:
    """paper.md: every table, then every claim."""
    parts = [f"# {_TITLE}", _NOTE]
    for each in (*tables(found), table.claims(found)):
        parts += [f"## {each.title}", each.markdown()]
    return "\n\n".join(parts) + "\n"


def verdict(found: dict[str, Any]) -> Verdict:
    """How many of the paper's statements hold here."""
    said = [claim["agrees"] for f in found["figures"] for claim in f["claims"]]
    said += [statement["agrees"] for statement in found["statements"]]
    joints = ", ".join(PaperJoint(name).label for name in found["joints"])
    return Verdict(f"{sum(said)} of {len(said)} statements of the paper hold here, on {joints}; seed {found['seed']}.")


def write(folder: Path, figures: Sequence[Shown], found: dict[str, Any]) -> None:
    """Page, Markdown and JSON into `folder`. Raises BadInput when it cannot be written."""
    page = Page(_TITLE, verdict(found))
    page.sentence(_NOTE)
    for each in tables(found):
        page.heading(each.title)
        page.table(each)
    for s in figures:
        page.heading(f"Fig. {s.number}" if s.number[0].isdigit() else s.number)
        for claim in s.claims:
            page.sentence(str(claim))
        page.figure(s.figure)
    for about in dict.fromkeys(said["about"] for said in found["statements"]):
        page.heading(about.capitalize())
        for said in found["statements"]:
            if said["about"] == about:
                page.sentence(str(Claim(said["paper"], said["here"], said["agrees"])))
    page.write(folder / "paper.html")
    write_bytes(folder / "paper.md", markdown(found).encode())
    write_bytes(folder / "paper.json", (json.dumps(found, indent=1, allow_nan=False) + "\n").encode())
