"""The whole campaign: scenarios one after the other, or several of those in virtual time at once.

Above `run`; used by `servoctl faults`. Whoever takes the outcomes may stop in between and keeps what came so far.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed

from servod.common.errors import ServodError
from servod.qualify.faults.judge import Reaction
from servod.qualify.faults.losses import loss_of
from servod.qualify.faults.run import Outcome, run_scenario
from servod.qualify.faults.scenario import Runs, Scenario

Scenarios = Mapping[str, Scenario]


def outcomes(scenarios: Scenarios, jobs: int = 1) -> Iterator[Outcome]:
    """Each outcome as it comes: first those in virtual time, `jobs` at once, then those on the wall clock one by one.

    Those of the guest machine are left out: its own script runs them.
    """
    stepped = {name: s for name, s in scenarios.items() if s.runs is Runs.STEPPED}
    if jobs > 1:
        yield from _at_once(stepped, jobs)
    else:
        yield from (outcome_of(name, scenario) for name, scenario in stepped.items())
    yield from (outcome_of(name, s) for name, s in scenarios.items() if s.runs is Runs.PROCESSES)


def outcome_of(name: str, scenario: Scenario) -> Outcome:
    """How the scenario ended; one whose axis did not get to the start, or that broke off, has failed for that."""
    try:
        return run_scenario(name, scenario)
    except ServodError as error:
        return _without_end(name, scenario, "not started", str(error))
    except Exception as error:  # a mistake of ours: the other scenarios and the report are not lost for it
        return _broken_off(name, scenario, error)


def _broken_off(name: str, scenario: Scenario, error: BaseException) -> Outcome:
    why = " ".join(f"{type(error).__name__}: {error}".split())
    return _without_end(name, scenario, "broken off", why)


def _without_end(name: str, scenario: Scenario, axis: str, why: str) -> Outcome:
    injected = ", ".join(i.action for i in scenario.inject)
    nothing = Reaction(None, None)
    return Outcome(
        name,
        scenario.title,
        scenario.group,
        injected,
        (),
        "",
        axis,
        nothing,
        None,
        False,
        (why,),
        loss_of(scenario),
        scenario.expect.exempt,
    )


def _at_once(scenarios: Scenarios, jobs: int) -> Iterator[Outcome]:
    """In processes of their own; what has not begun when the taker stops never begins."""
    pool = ProcessPoolExecutor(
        jobs,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),  # Ctrl-C is for the one who takes the outcomes
    )
    with contextlib.ExitStack() as stack:
        stack.callback(pool.shutdown, wait=True, cancel_futures=True)
        running = {pool.submit(outcome_of, name, scenario): name for name, scenario in scenarios.items()}
        for done in as_completed(running):
            died, name = done.exception(), running[done]
            yield done.result() if died is None else _broken_off(name, scenarios[name], died)
