"""Step 7: one page that shows all of it, and its pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from servod import __version__
from servod.lab.commission.report import write_report
from servod.lab.commission.state import DEPLOYMENT, GAINS, IDENTIFIED, MODEL, PICTURES, REPORT, TRACKING, TUNING
from servod.lab.commission.walk import Walk


@dataclass(frozen=True)
class Report:
    """Leaves report.html and the pictures."""

    name: str = "report"
    title: str = "report"

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        """Files in the walk's folder."""
        return (REPORT, PICTURES)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """Everything that is shown."""
        return {**walk.hashes(IDENTIFIED, MODEL, GAINS, DEPLOYMENT, TRACKING, TUNING), "version": __version__}

    def run(self, walk: Walk) -> None:
        """From the folder's files alone."""
        with walk.progress(self.title) as tell:
            write_report(walk, tell)
