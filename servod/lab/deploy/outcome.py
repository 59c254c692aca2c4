"""How a trial ended: what was measured, the verdict, and which set runs now, for people and as a document.

Out of the trial; the command line, the walk of a commissioning and its report read it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

from servod.formats.gains.gain_set import Promise
from servod.lab.deploy.judge import promise_document
from servod.lab.recordings.recording import Rows
from servod.lab.verify.validation import Figures


class Ending(Enum):
    """What became of the set; the values are for documents."""

    KEPT = "kept"
    ROLLED_BACK = "rolled_back"
    CONFIRMED = "confirmed"  # it ran already, and proved itself
    DOUBTED = "doubted"  # it ran already and did not; nothing was on trial, so that it still runs


@dataclass(frozen=True)
class Baseline:
    """The cycles of the motion as it ran under the set `present` (name, version) before the change to another one."""

    present: tuple[str, int]
    rows: Rows


@dataclass(frozen=True)
class Deployment:
    """One trial. Of a set that ran already there may be nothing before; then it was judged by its promise alone."""

    ending: Ending
    reasons: tuple[str, ...]
    name: str
    version: int
    promised: Promise
    before: Figures | None
    after: Figures | None
    ran_before: Baseline | None
    rows_after: Rows | None

    @property
    def proven(self) -> bool:
        """Whether the new set proved itself; then it is the one that runs."""
        return self.ending in (Ending.KEPT, Ending.CONFIRMED)

    @property
    def said(self) -> str:
        """Set, verdict and what runs now, in one line."""
        new, why = _named((self.name, self.version)), "; ".join(self.reasons)
        old = f" {_named(self.ran_before.present)}" if self.ran_before else ""
        return {
            Ending.KEPT: f"deployed: {new}",
            Ending.ROLLED_BACK: f"rolled back to{old}: {why}",
            Ending.CONFIRMED: f"{new} ran already and runs on: it does what its certificate promised",
            Ending.DOUBTED: f"{new} ran already and STILL RUNS, for nothing else was on trial; `servoctl gains "
            f"rollback` goes back to the set before it: {why}",
        }[self.ending]

    def document(self) -> dict[str, Any]:
        """Plain values, figures in mrad; `present` is the set that ran before, where one was measured."""
        present = self.ran_before and dict(zip(("name", "version"), self.ran_before.present, strict=True))
        return {
            "deployed": self.proven,
            "outcome": self.ending.value,
            "reasons": list(self.reasons),
            "gains": {"name": self.name, "version": self.version},
            "present": present,
            "before": self.before and self.before.document(),
            "after": self.after and self.after.document(),
            "promised": promise_document(self.promised),
        }


def _named(stored: tuple[str, int]) -> str:
    return f"{stored[0]} version {stored[1]}"
