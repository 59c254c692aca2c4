"""What the keys of an axis model file have in common: ranges of numbers, and sums of sines over position.

Under the groups of keys of friction and of everything else. Torque means force and rad means m when `axis: linear`.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from servod.common.yaml import Strict

Factor = Annotated[float, Field(gt=0.0, le=100.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Positive = Annotated[float, Field(gt=0.0)]
Phase = Annotated[float, Field(ge=-100.0, le=100.0, description="rad, at position 0")]


class Harmonic(Strict):
    """One sine over position: amplitude*sin(n*x + phase), n = periods_per_turn (2*pi*periods_per_metre when linear)."""

    amplitude: float = Field(description="in the unit of the group it stands in")
    periods_per_turn: float | None = Field(None, gt=0.0, le=100_000.0, description="rotary axes: periods in 2*pi rad")
    periods_per_metre: float | None = Field(None, gt=0.0, le=10_000_000.0, description="linear axes: periods in 1 m")
    phase: Phase = 0.0

    @model_validator(mode="after")
    def _one_period(self) -> Harmonic:
        if (self.periods_per_turn is None) == (self.periods_per_metre is None):
            raise ValueError("exactly one of periods_per_turn and periods_per_metre")
        return self


class Group(Strict):
    """One optional group of keys: the record of an effect for whoever reads, checks or packs a model.

    `plain`: the kernels' plain loop obeys the group, or it is not in the dynamics at all; beside any other the full
    loop runs. `under_one`: the power of n with which |amplitude|*n^power of its waves must sum to less than 1 (0:
    shares, 1: slopes), if any. `balanced`: of a joint that slides one way the command still is what inertia, friction
    over velocity and torque over position ask for; `held`: such a torque has a mean, so that a law must know it.
    """

    plain: ClassVar[bool] = False
    balanced: ClassVar[bool] = False
    held: ClassVar[bool] = False
    under_one: ClassVar[int | None] = None

    @property
    def waves(self) -> tuple[Harmonic, ...]:
        """Its sines over position."""
        return ()


class Harmonics(Group):
    """A sum of sines over position."""

    harmonics: tuple[Harmonic, ...] = Field(min_length=1, max_length=64)

    @property
    def waves(self) -> tuple[Harmonic, ...]:
        """All of them."""
        return self.harmonics
