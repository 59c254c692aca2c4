"""The base of all actions: a strict model of the arguments with `apply`, and the trace by which its effect is known."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar

from servod.common.yaml import Strict
from servod.qualify.faults.scenario import Loss, Runs
from servod.qualify.faults.under_test import AMPLIFIER, ENCODER

if TYPE_CHECKING:
    from servod.qualify.faults.under_test import AxisUnderTest


class Who(StrEnum):
    """A participant of the bus."""

    AMPLIFIER = "amplifier"
    ENCODER = "encoder"
    LOOP = "loop"


NODE_ID = {Who.AMPLIFIER: AMPLIFIER, Who.ENCODER: ENCODER}


class InjectionAction(Strict):
    """One kind of injection; `runs` says which axes under test can show it, `traceless` what is told when it left no
    trace."""

    runs: ClassVar[frozenset[Runs]] = frozenset({Runs.STEPPED, Runs.PROCESSES})
    traceless: ClassVar[str] = "it had no effect"

    def loss(self) -> Loss:
        """What this takes from an axis with power; most actions leave it everything."""
        return Loss.NONE

    def mark(self) -> Hashable:
        """By what its effect is counted; actions with the same mark are counted together."""
        return type(self)

    def wanted(self) -> int:
        """How often it must take effect."""
        return 1

    def effect(self, axis: AxisUnderTest) -> int:
        """How often actions with this mark took effect so far."""
        return axis.effects[self.mark()]

    def took(self, axis: AxisUnderTest, times: int) -> None:
        """Count an effect that was seen."""
        axis.effects[self.mark()] += times

    @abstractmethod
    def apply(self, axis: AxisUnderTest) -> None:
        """Let it happen to `axis` now."""
