"""What a soak counts on its axis, and what it asks of one, whatever the axis runs on."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from servod.qualify.soak.finding import Findings
from servod.qualify.soak.plan import Episode
from servod.qualify.soak.tally import Tally


class Counts(NamedTuple):
    """Three counters of the same cycles by three witnesses, and what else was checked.

    `cycles`: as the loop numbers them, `rows`: as they were recorded, `missed`: periods that the loop skipped; `syncs`:
    SYNC frames that an independent listener heard, `syncs_taken`: those that a fault of the schedule took. `recordings`
    of the recorder were read back and had all `rows_read_back`.
    """

    period_ns: int
    cycles: int
    rows: int
    missed: int
    syncs: int
    syncs_taken: int
    drive_samples: int
    recordings: int
    rows_read_back: int


class SoakedAxis(Protocol):
    """An axis in a soak."""

    findings: Findings
    tally: Tally

    @property
    def counts(self) -> Counts:
        """What was counted so far."""
        ...

    def processes(self) -> dict[str, int]:
        """Processes whose memory is watched: name and process id."""
        ...

    def episode(self, episode: Episode) -> None:
        """Let one episode happen. Raises AnswerIsNo when the axis cannot be enabled any more, by nothing."""
        ...

    def finish(self) -> None:
        """Check what is left to check. Raises ServodError when the axis does not come to its end."""
        ...

    def close(self) -> None:
        """Leave everything."""
        ...
