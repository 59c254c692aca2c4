"""The demo SYNC-stepped: the same runs in virtual time, two at once, as fast as they compute.

Beside the data path. Each run is a session of its own (servod.client.stepped) in a worker process, from the same start.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from servod.common.portable import usable_cores
from servod.common.workers import worker_pool
from servod.qualify.demo.axis import demo_config
from servod.qualify.demo.entries import Entry
from servod.qualify.demo.runs import Run, cut_motion

Progress = Callable[[str, float], None]

_POLL_S = 0.2
_shares: Any = None  # one share of progress for each entry, in memory that the workers share


def run_fast(plant: Path, duration_s: float, rows: Sequence[Entry], progress: Progress) -> list[Run]:
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


def _run(index: int, row: Entry, plant: str, duration_s: float, folder: str) -> bytes:
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
    return axis.run(ReferenceMotion.paper(duration_s), lambda passed_s: _tell(index, passed_s / duration_s), 0.5)


def _tell(index: int, share: float) -> None:
    _shares[index] = min(1.0, share)
