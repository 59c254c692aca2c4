"""One tracking run as arrays, cut from the daemon's recording or a stepped session's records.

Behind the recorder; demo, benchmark and report read runs from here. Needs numpy (the lab part).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import AnswerIsNo
from servod.common.portable import usable_cores
from servod.common.workers import worker_pool
from servod.lab.recordings.recording import ROW
from servod.lab.tracking.metrics import Score, score
from servod.qualify.demo.axis import CONTROLLERS, demo_config
from servod.qualify.demo.entries import DemoRow


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


# --- In virtual time -------------------------------------------------------------------------------------------------
# The demo SYNC-stepped: the same runs in virtual time, two at once, as fast as they compute. Each run is a session of
# its own (servod.client.stepped) in a worker process, from the same start.


Progress = Callable[[str, float], None]

_POLL_S = 0.2
_shares: Any = None  # one share of progress for each entry, in memory that the workers share


def run_fast(plant: Path, duration_s: float, rows: Sequence[DemoRow], progress: Progress) -> list[Run]:
    """Track trajectory (19) for `duration_s` of virtual time under each entry. Raises as the session does."""
    shares = get_context("spawn").Array("d", len(rows), lock=False)
    workers = min(len(rows), usable_cores())
    # Outermost, for a worker that is ended cleans nothing up.
    with (
        tempfile.TemporaryDirectory(prefix="servod-demo-") as folder,
        worker_pool(workers, _start_worker, shares) as pool,
    ):
        results = [pool.submit(_run, index, row, str(plant), duration_s, folder) for index, row in enumerate(rows)]
        left = set(results)
        while left:
            ended, left = wait(left, _POLL_S, FIRST_COMPLETED)
            for result in ended:
                result.result()  # the first failure ends all
            for row, share in zip(rows, shares, strict=True):
                progress(row.name, share)
        return [cut_motion(row.name, result.result()) for row, result in zip(rows, results, strict=True)]


def _start_worker(shares: Any) -> None:
    """Keeps the memory that it shares with the parent."""
    global _shares  # noqa: PLW0603  (how a pool hands inherited memory to its workers)
    _shares = shares


def _run(index: int, row: DemoRow, plant: str, duration_s: float, folder: str) -> bytes:
    """One entry in this process: the packed records of its motion."""
    from servod.client.axis import ReferenceMotion
    from servod.client.stepped import SteppedAxis, SteppedSession
    from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
    from servod.formats.gains.gain_set import load_gains
    from servod.formats.model.axis_model import load_axis_model

    gains, own = load_gains(row.gains), Path(folder) / str(index)
    own.mkdir()
    world = SteppedWorld(VirtualAxisSettings(), load_axis_model(plant))
    session = SteppedSession(demo_config(own, own), world, gains.law.number, gains.pack())
    axis = SteppedAxis(session, own, gains)
    axis.enable()
    return axis.run(ReferenceMotion.paper(duration_s), lambda passed_s: _note_share(index, passed_s / duration_s), 0.5)


def _note_share(index: int, share: float) -> None:
    _shares[index] = min(1.0, share)
