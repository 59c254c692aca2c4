"""A statement of the paper, judged by figures of the run: what agrees and what does not is decided by numbers alone.

Under the figures of `paper`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from servod.lab.report.figure import Figure


@dataclass(frozen=True, slots=True)
class Claim:
    """What the paper says (or shows), what this run found, and whether the one holds by the other."""

    paper: str
    here: str
    agrees: bool

    def __str__(self) -> str:
        return f"{'Agrees' if self.agrees else 'Does not agree'}: {self.paper}; here {self.here}."


@dataclass(frozen=True)
class Shown:
    """One figure of the paper from this software, with its claims; `number` is the paper's, `where` names the joint."""

    number: str
    figure: Figure
    claims: tuple[Claim, ...]
    where: str = ""

    def document(self) -> dict[str, Any]:
        """Plain values, as JSON has them; without the curves."""
        return {
            "number": self.number,
            "where": self.where,
            "name": self.figure.name,
            "title": self.figure.title,
            "claims": [asdict(claim) for claim in self.claims],
        }


def least(label: str, values: Mapping[str, float], paper: str) -> Claim:
    """Whether `label` has the least of `values` [mrad RMS]."""
    here = ", ".join(f"{name} {value:.4g}" for name, value in values.items()) + " mrad RMS"
    return Claim(paper, here, values[label] == min(values.values()))


def ordered(values: Sequence[tuple[str, float]], paper: str) -> Claim:
    """Whether `values` [mrad RMS] fall from each to the next."""
    here = " then ".join(f"{name} {value:.4g}" for name, value in values) + " mrad RMS"
    falls = all(a > b for (_, a), (_, b) in itertools.pairwise(values))
    return Claim(paper, here, falls)
