"""Actions from the master's side: commands, gains and what the machine around the axis does to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from servod.campaign.actions.base import Action
from servod.campaign.scenario import Runs
from servod.commands import Op
from servod.controllers import LAWS

if TYPE_CHECKING:
    from servod.campaign.under_test import AxisUnderTest


class Gains(Action):
    """Other gains act from now on, past the store and its certificate: the limits are on their own."""

    runs: ClassVar[frozenset[Runs]] = frozenset({Runs.STEPPED})
    law: str
    parameters: list[float | str]

    def apply(self, axis: AxisUnderTest) -> None:
        """Activate them ("nan" and "inf" are written as text)."""
        numbers = [float(p) for p in self.parameters]
        axis.command(Op.ACTIVATE, [1, LAWS[self.law].number, len(numbers), *numbers])


MACHINE_ACTIONS: dict[str, type[Action]] = {"gains": Gains}
