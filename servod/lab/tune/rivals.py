"""All contenders of a comparison, tuned by the same rules in both classes, over worker processes.

Stands on `tuning`. The free class of a rival starts from its equal class, and a rival from its forerunners, which have
some of its numbers fixed, so that more freedom is never worse.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace

from servod.common.portable import usable_cores
from servod.common.progress import OnProgress
from servod.common.workers import worker_pool
from servod.formats.model.axis_model import AxisModel
from servod.lab.tune.laws import RIVALS
from servod.lab.tune.plan import BUDGET, Feedback, Tuned, TuningSettings
from servod.lab.tune.tuning import Values, tune

Key = tuple[Feedback, str]

_POLL_S = 0.05


def rivals(
    model: AxisModel,
    names: Sequence[str] = tuple(RIVALS),
    *,
    seed: int = 1,
    budget: int = BUDGET,
    on_progress: OnProgress | None = None,
    plan: TuningSettings | None = None,
    processes: int | None = None,
) -> dict[Feedback, dict[str, Tuned]]:
    """The rivals `names` of servod.lab.tune.laws.RIVALS tuned in both classes on `model`'s intervals.

    `plan` says encoder, filter, limits and whatever else is not `seed` and `budget`. The result depends neither on the
    number of `processes` (default: one for each core) nor on their timing. Ctrl-C ends the workers at once. Raises
    BadInput when the model has no bristle stiffness to compensate.
    """
    plan = replace(plan or TuningSettings(), seed=seed, budget=budget)
    with worker_pool(processes or usable_cores()) as pool:
        found = _Field(pool, model, names, plan, on_progress).tuned()
    return {feedback: {name: found[feedback, name] for name in names} for feedback in Feedback}


def tuned_in_turn(model: AxisModel, names: Sequence[str], plan: TuningSettings) -> dict[Key, Tuned]:
    """The rivals `names` in both classes by the same rules, one after the other in this process, without workers."""
    found: dict[Key, Tuned] = {}
    for key in needed(names):
        found[key] = tune(model, key[1], key[0], plan, [found[before].values for before in start_points(key)])
    return found


def start_points(key: Key) -> list[Key]:
    """Whose best sets a search starts from: its forerunners in the same class, and its own equal class."""
    feedback, name = key
    own = [(Feedback.EQUAL, name)] if feedback is Feedback.FREE else []
    return [*((feedback, forerunner) for forerunner in RIVALS[name].forerunners), *own]


def needed(names: Sequence[str]) -> list[Key]:
    """Every search that tuning `names` takes, each behind those that it starts from."""
    every: list[Key] = []

    def add(key: Key) -> None:
        for before in start_points(key):
            add(before)
        if key not in every:
            every.append(key)

    for feedback in Feedback:
        for name in names:
            add((feedback, name))
    return every


class _Field:
    """The running tasks and what they have found."""

    def __init__(
        self,
        pool: Executor,
        model: AxisModel,
        names: Sequence[str],
        plan: TuningSettings,
        on_progress: OnProgress | None,
    ) -> None:
        self._waiting = needed(names)
        self._all = len(self._waiting)
        self._pool, self._text, self._plan, self._on_progress = pool, model.model_dump_json(), plan, on_progress
        self._tasks: dict[Key, Future[Tuned]] = {}
        self._found: dict[Key, Tuned] = {}

    def tuned(self) -> dict[Key, Tuned]:
        """Wait for everything; the first failure is raised."""
        while self._waiting or self._tasks:
            for key in [key for key in self._waiting if all(before in self._found for before in start_points(key))]:
                self._begin(key)
            for key in [key for key, task in self._tasks.items() if task.done()]:
                self._take(key)
            time.sleep(_POLL_S)
        return self._found

    def _begin(self, key: Key) -> None:
        self._waiting.remove(key)
        starts = [self._found[before].values for before in start_points(key)]
        self._tasks[key] = self._pool.submit(_task, self._text, key, self._plan, starts)

    def _take(self, key: Key) -> None:
        feedback, name = key
        self._found[key] = self._tasks.pop(key).result()
        if self._on_progress:
            self._on_progress(f"{name}, {feedback.value} feedback", len(self._found) / self._all)


def _task(model: str, key: Key, plan: TuningSettings, starts: Sequence[Values]) -> Tuned:
    return tune(AxisModel.model_validate_json(model), key[1], key[0], plan, starts)
