"""What a scenario takes from the axis, by its actions and not by its own word, and whether it is bound as it must be.

Between the actions and their readers: the check of a scenario's file, and the table of outcomes. A scenario to which
the bound does not apply says why (`exempt`), and is counted and shown.
"""

from __future__ import annotations

from servod.common.errors import BadInput
from servod.qualify.faults.actions import action_of
from servod.qualify.faults.scenario import FEEDBACK_LOSS_MS, MASTER_LOSS_MS, POWERED, Expectation, Loss, Scenario


def loss_of(scenario: Scenario) -> Loss:
    """The loss with the tightest bound among those of its actions; an axis without power has nothing to lose."""
    if scenario.start not in POWERED:
        return Loss.NONE
    losses = {action_of(i, scenario.title, scenario.runs).loss() for i in scenario.inject}
    return next((loss for loss in (Loss.FEEDBACK, Loss.MASTER) if loss in losses), Loss.NONE)


def check_bounds(scenario: Scenario, where: str) -> None:
    """Raises BadInput for a loss without its bound, and for an exemption from none."""
    expected, loss = scenario.expect, loss_of(scenario)
    if expected.exempt is not None:
        if loss is Loss.NONE:
            raise BadInput(f"{where}: expect.exempt", "a scenario that takes nothing away", "no exemption")
    elif loss is Loss.MASTER and not _within(expected.torque_gone_ms, MASTER_LOSS_MS):
        raise _unbound(expected, where, "torque_gone_ms", MASTER_LOSS_MS, "the master")
    elif loss is Loss.FEEDBACK and not _within(expected.reaction_ms, FEEDBACK_LOSS_MS):
        raise _unbound(expected, where, "reaction_ms", FEEDBACK_LOSS_MS, "feedback")


def _within(stated_ms: float | None, bound_ms: float) -> bool:
    return stated_ms is not None and stated_ms <= bound_ms


def _unbound(expected: Expectation, where: str, key: str, bound_ms: float, what: str) -> BadInput:
    allowed = f"{key} of at most {bound_ms:g} after a loss of {what}, or `exempt` with the reason"
    return BadInput(f"{where}: expect.{key}", getattr(expected, key), allowed)
