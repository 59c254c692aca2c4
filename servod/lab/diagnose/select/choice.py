"""The outcome of the selection: fits, and for each term what it is worth and how it came in.

Stands between the selection, what refines it (`detail`, `slow`, `swap`) and the verdict.
"""

from __future__ import annotations

from dataclasses import dataclass

from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit


@dataclass(frozen=True)
class Entry:
    """How a term came in: what it left of the cost as a share, and the other candidates."""

    left: float
    rivals: list[Candidate]


@dataclass
class Choice:
    """The outcome: the fit with all that is named, the fit of the base alone, and for each term how it came in.

    `cut`: time ended the search while something was left.
    """

    base: Fit
    fit: Fit
    merits: list[Merit]
    entries: list[Entry]
    minor: dict[str, Merit]
    floor: float
    tried: int
    cut: bool = False

    def drop(self, index: int, less: Fit) -> None:
        """Take a term out; `less` is the fit without it."""
        self.fit = less
        self.merits.pop(index)
        self.entries.pop(index)
