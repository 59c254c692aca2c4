"""One tracking run as arrays, cut from the daemon's recording or a stepped session's records.

Behind the recorder; demo, benchmark and report read runs from here. Needs numpy (the lab part).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import AnswerIsNo
from servod.lab.recordings.recording import ROW
from servod.lab.tracking.metrics import Score, score
from servod.qualify.demo.axis import CONTROLLERS


@dataclass(frozen=True)
class Run:
    """The cycles of one motion under one controller; `rows` has the fields of servod.formats.recording.record."""

    controller: str
    rows: NDArray[np.void]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Time since the motion began."""
        time_ns = self.rows["time_ns"]
        return (time_ns - time_ns[0]) * 1e-9  # type: ignore[no-any-return]

    @property
    def error_mrad(self) -> NDArray[np.float64]:
        """Reference minus encoder position."""
        return (self.rows["reference_rad"] - self.rows["position_rad"]) * 1e3  # type: ignore[no-any-return]

    @property
    def cycles(self) -> int:
        """Periods from first to last cycle, skipped ones included."""
        return int(self.rows["cycle"][-1] - self.rows["cycle"][0]) + 1

    @property
    def missed(self) -> int:
        """Periods that the loop skipped in this run."""
        return int(self.rows["missed"][-1] - self.rows["missed"][0])

    def score(self) -> Score:
        """RMS and largest error without the first second. Raises AnswerIsNo when the run is shorter than that."""
        return score(self.time_s, self.error_mrad)


def cut_motion(controller: str, raw: bytes | bytearray) -> Run:
    """The cycles of `raw` (packed cycle records) in which a reference motion ran. Raises AnswerIsNo when none did."""
    rows = np.frombuffer(raw, dtype=ROW)
    moving = rows[rows["reference_active"] == 1]
    if moving.size == 0:
        raise AnswerIsNo(f"no motion was recorded under {controller}")
    return Run(controller, moving)


def summary(runs: list[Run], wall_s: float) -> dict[str, Any]:
    """The demo's JSON document: the score of each controller, their cycles and missed periods, and elapsed time.

    Runs under gain sets beside the four controllers, the certified one included, stand under `others`, which is there
    only when there are any.
    """
    scores = {run.controller: asdict(run.score()) for run in runs}
    others = {name: scores.pop(name) for name in list(scores) if name not in CONTROLLERS}
    runs = [run for run in runs if run.controller in scores]
    return {
        "controllers": scores,
        **({"others": others} if others else {}),
        "cycles": sum(run.cycles for run in runs),
        "missed": sum(run.missed for run in runs),
        "wall_s": wall_s,
    }
