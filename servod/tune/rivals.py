"""All contenders of a comparison, tuned by the same rules in both classes, over worker processes.

Stands on `tuning`. Each rival is one task: its equal class, then its free class, which starts from there.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.pool import AsyncResult
from typing import Any

from servod.axis_model import AxisModel
from servod.tune.laws import RIVALS
from servod.tune.plan import BUDGET, Feedback, Tuned, TunePlan
from servod.tune.tuning import tune

#: Told how much of all tunings is done, from 0 to 1, by rival and class.
Tell = Callable[[str, float], None]
Both = dict[Feedback, Tuned]

_POLL_S = 0.2
_shares: Any = None  # of each rival, in memory that the workers share


def rivals(
    model: AxisModel,
    *,
    seed: int = 1,
    budget: int = BUDGET,
    tell: Tell | None = None,
    plan: TunePlan | None = None,
    processes: int | None = None,
) -> dict[Feedback, dict[str, Tuned]]:
    """Every rival of servod.tune.laws.RIVALS tuned in both classes on `model`'s intervals.

    `plan` says encoder, filter, limits and whatever else is not `seed` and `budget`. The result depends neither on the
    number of `processes` (default: one for each core) nor on their timing. Ctrl-C ends the workers at once. Raises
    BadInput when the model has no bristle stiffness to compensate.
    """
    plan = replace(plan or TunePlan(), seed=seed, budget=budget)
    workers = processes or min(len(os.sched_getaffinity(0)), len(RIVALS))
    found = _alone(model, plan, tell) if workers == 1 else _together(model, plan, workers, tell)
    return {feedback: {name: found[name][feedback] for name in RIVALS} for feedback in Feedback}


def both_classes(model: AxisModel, name: str, plan: TunePlan, tell: Callable[[float], None] | None = None) -> Both:
    """One rival in the equal class, then in the free class from there."""

    def half(offset: float) -> Callable[[float], None] | None:
        return None if tell is None else lambda share: tell(offset + 0.5 * share)

    equal, values = tune(model, name, Feedback.EQUAL, plan, None, half(0.0))
    free, _ = tune(model, name, Feedback.FREE, plan, values, half(0.5))
    return {Feedback.EQUAL: equal, Feedback.FREE: free}


def _alone(model: AxisModel, plan: TunePlan, tell: Tell | None) -> dict[str, Both]:
    """Everything in this process."""

    def one(name: str) -> Both:
        return both_classes(model, name, plan, None if tell is None else lambda share: tell(name, share))

    return {name: one(name) for name in RIVALS}


def _together(model: AxisModel, plan: TunePlan, workers: int, tell: Tell | None) -> dict[str, Both]:
    """One task for each rival; the pool ends with the block, however it ends."""
    context = multiprocessing.get_context("spawn")
    shares = context.Array("d", len(RIVALS), lock=False)
    with context.Pool(workers, _start_worker, (shares,)) as pool:
        text = model.model_dump_json()
        tasks = {name: pool.apply_async(_task, (i, text, name, plan)) for i, name in enumerate(RIVALS)}
        _watch(tasks, shares, tell)
        return {name: task.get() for name, task in tasks.items()}


def _watch(tasks: dict[str, AsyncResult[Both]], shares: Any, tell: Tell | None) -> None:
    """Tell until all is done, or the first task fails."""
    while not all(task.ready() for task in tasks.values()):
        next(task for task in tasks.values() if not task.ready()).wait(_POLL_S)
        for name, share in zip(tasks, shares, strict=True):
            if tasks[name].ready():
                tasks[name].get()
            if tell:
                tell(name, share)


def _start_worker(shares: Any) -> None:
    """Ctrl-C is for the parent, which ends the pool."""
    global _shares  # noqa: PLW0603  (how a pool hands inherited memory to its workers)
    _shares = shares
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _task(index: int, model: str, name: str, plan: TunePlan) -> Both:
    def tell(share: float) -> None:
        _shares[index] = share

    return both_classes(AxisModel.model_validate_json(model), name, plan, tell)
