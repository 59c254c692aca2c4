"""What an injection can do to an axis under test: one class for each action, in one table.

An action is the model of its own arguments (checked when the scenario is read) with `apply`. The files of this folder
group them: `bus` (frames, wires, NMT, objects of the nodes), `machine` (commands, gains, configuration), `processes`
and `guest`.
"""

from __future__ import annotations

from servod.common.errors import BadInput
from servod.common.yaml import validate
from servod.qualify.faults.actions.base import InjectionAction
from servod.qualify.faults.actions.bus import BUS_ACTIONS, NODE_ACTIONS
from servod.qualify.faults.actions.guest import GUEST_ACTIONS
from servod.qualify.faults.actions.machine import GAIN_FILE_ACTIONS, MACHINE_ACTIONS
from servod.qualify.faults.actions.processes import PROCESS_ACTIONS
from servod.qualify.faults.scenario import Injection, Runs

__all__ = ["ACTIONS", "InjectionAction", "action_of"]

#: The one table of actions: name in the scenario's file -> model of its arguments.
ACTIONS: dict[str, type[InjectionAction]] = {
    **BUS_ACTIONS,
    **NODE_ACTIONS,
    **MACHINE_ACTIONS,
    **PROCESS_ACTIONS,
    **GAIN_FILE_ACTIONS,
    **GUEST_ACTIONS,
}


def action_of(injection: Injection, where: str, runs: Runs) -> InjectionAction:
    """The action that `injection` names, with its arguments checked; raises BadInput."""
    action = ACTIONS.get(injection.action)
    if action is None:
        raise BadInput(f"{where}.do", repr(injection.action), f"one of {', '.join(sorted(ACTIONS))}")
    if runs not in action.runs:
        raise BadInput(f"{where}.do", f"{injection.action} on {runs}", f"an action that {runs} can do")
    return validate(injection.arguments, action, f"{where}.do.{injection.action}")
