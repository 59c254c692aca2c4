"""Whether what a scenario injects really happened: a fault that hits nothing proves nothing.

Part of the judge. Each action knows its trace: frames that the hub struck, a node that took a value, a process that got
its signal. Beside the injection on purpose: an injection that does nothing cannot say that it did.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator

from servod.qualify.faults.actions import Action, action_of
from servod.qualify.faults.scenario import Scenario
from servod.qualify.faults.under_test import AxisUnderTest


class Effects:
    """Counts the effects of a scenario's injections on `axis`, from the moment at which this is made."""

    def __init__(self, scenario: Scenario, axis: AxisUnderTest) -> None:
        self._axis = axis
        self._actions: dict[Hashable, list[Action]] = {}
        for injection in scenario.inject:
            action = action_of(injection, scenario.title, scenario.runs)
            self._actions.setdefault(action.mark(), []).append(action)
        self._before = {mark: actions[0].effect(axis) for mark, actions in self._actions.items()}

    def complaints(self) -> Iterator[str]:
        """What did not happen, or not as often as it should have."""
        for mark, actions in self._actions.items():
            wanted = sum(action.wanted() for action in actions)
            seen = actions[0].effect(self._axis) - self._before[mark]
            if seen < wanted:
                often = "" if not seen else f" ({seen} of {wanted} times)"
                yield f"the fault did not happen: {actions[0].traceless}{often}"
