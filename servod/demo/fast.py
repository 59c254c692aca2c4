"""The demo SYNC-stepped: the same runs in virtual time, two at once, as fast as they compute.

Beside the data path. Each run is a session of its own (servod.session) in a worker process, from the same start.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Sequence
from multiprocessing.pool import AsyncResult
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servod.axis import AxisState
from servod.commands import REFUSAL_TEXT, Op, ReferenceKind, Refusal
from servod.demo.axis import demo_config
from servod.demo.entries import Entry
from servod.demo.runs import Run, cut_motion
from servod.errors import AnswerIsNo

if TYPE_CHECKING:
    from servod.session import SteppedSession

Progress = Callable[[str, float], None]

_SLICE_S = 0.5
_POLL_S = 0.2
_shares: Any = None  # one share of progress for each entry, in memory that the workers share


def run_fast(plant: Path, duration_s: float, rows: Sequence[Entry], progress: Progress) -> list[Run]:
    """Track trajectory (19) for `duration_s` of virtual time under each entry. Raises as the session does."""
    context = multiprocessing.get_context("spawn")
    shares = context.Array("d", len(rows), lock=False)
    workers = min(len(rows), len(os.sched_getaffinity(0)))
    with context.Pool(workers, _start_worker, (shares,)) as pool:
        results = [pool.apply_async(_run, (index, row, str(plant), duration_s)) for index, row in enumerate(rows)]
        while not all(result.ready() for result in results):
            next(r for r in results if not r.ready()).wait(_POLL_S)
            _raise_first_failure(results)
            for row, share in zip(rows, shares, strict=True):
                progress(row.name, share)
        return [cut_motion(row.name, result.get()) for row, result in zip(rows, results, strict=True)]


def _raise_first_failure(results: list[AsyncResult[bytes]]) -> None:
    for result in results:
        if result.ready() and not result.successful():
            result.get()


def _start_worker(shares: Any) -> None:
    """Ctrl-C is for the parent, which ends the pool."""
    global _shares  # noqa: PLW0603  (how a pool hands inherited memory to its workers)
    _shares = shares
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(index: int, row: Entry, plant: str, duration_s: float) -> bytes:
    """One entry in this process: the packed records of its motion."""
    from servod.axis_model import load_axis_model
    from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
    from servod.gains import load_gains
    from servod.session import SteppedSession

    gains = load_gains(row.gains)
    with tempfile.TemporaryDirectory(prefix="servod-demo-") as folder:
        config = demo_config(Path(folder), Path(folder))
        world = SteppedWorld(VirtualAxisSettings(), load_axis_model(plant))
        session = SteppedSession(config, world, gains.law.number, gains.pack())
        session.enable()
        session.clear()
        refusal = session.send(Op.REFERENCE, [ReferenceKind.PAPER, duration_s])
        if refusal != Refusal.DONE:
            raise AnswerIsNo(REFUSAL_TEXT[refusal])
        _follow(session, index, row.name, duration_s)
    return session.raw


def _follow(session: SteppedSession, index: int, name: str, duration_s: float) -> None:
    """Run until the motion is over, and say how far it is. Raises AnswerIsNo when the axis drops out."""
    done_s = 0.0
    while session.cycle.reference.active:
        session.run(_SLICE_S)
        done_s += _SLICE_S
        _shares[index] = min(1.0, done_s / duration_s)
    if session.cycle.axis.state != AxisState.ENABLED:
        raise AnswerIsNo(f"the axis went to {session.cycle.axis.state.name} under {name}. {session.why}")
