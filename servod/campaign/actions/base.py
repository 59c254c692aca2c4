"""The base of all actions: a strict model of the arguments with `apply`."""

from __future__ import annotations

from abc import abstractmethod
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar

from servod.campaign.scenario import Loss, Runs
from servod.campaign.under_test import AMPLIFIER, ENCODER
from servod.yaml12 import Strict

if TYPE_CHECKING:
    from servod.campaign.under_test import AxisUnderTest


class Who(StrEnum):
    """A participant of the bus."""

    AMPLIFIER = "amplifier"
    ENCODER = "encoder"
    LOOP = "loop"


NODE_ID = {Who.AMPLIFIER: AMPLIFIER, Who.ENCODER: ENCODER}


class Action(Strict):
    """One kind of injection; `runs` says which axes under test can show it."""

    runs: ClassVar[frozenset[Runs]] = frozenset({Runs.STEPPED, Runs.PROCESSES})

    def loss(self) -> Loss:
        """What this takes from an axis with power; most actions leave it everything."""
        return Loss.NONE

    @abstractmethod
    def apply(self, axis: AxisUnderTest) -> None:
        """Let it happen to `axis` now."""
