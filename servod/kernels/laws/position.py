"""Feed-forward of the torques that only depend on where the joint stands: gravity, cogging, spring, constant offset.

Step (4) of the cycle, called by the `local` law for gain sets that know such torques. Evaluated at the reference, led
by the time that a command needs to act: at the reference it closes no loop, so that the certificate of the feedback
stays what it is, it carries neither encoder steps nor delay, and at rest nothing can hunt. (Cogging of 4 mN*m at 36 a
turn, 17 bit: trajectory (19) comes out alike both ways; a hold ripples 25 urad, and 56 evaluated at the encoder.)
While the joint is far from its reference, as in a step, the torque is that of the goal, and the feedback, ten times
stronger there, does the rest.
The phases are those of the loop's own position, in which the model was identified.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple


class PositionTorques(NamedTuple):
    """What is known over position, in the order in which a gain set packs it behind the law's own numbers."""

    lead: float = 0.0  # time by which the reference position is led [s]
    offset: float = 0.0  # constant torque [N*m]
    spring: float = 0.0  # stiffness [N*m/rad]
    spring_rest: float = 0.0  # position without torque [rad]
    spring_cubic: float = 0.0  # [N*m/rad^3]
    waves: Sequence[float] = ()  # amplitude [N*m], n [1/rad] and phase [rad] of each amplitude*sin(n*x + phase)

    @classmethod
    def from_flat(cls, values: Sequence[float]) -> PositionTorques:
        """Name the numbers that `flat` gives."""
        return cls._make((*values[:FIRST_WAVE], tuple(values[FIRST_WAVE:]))) if values else cls()

    def flat(self) -> tuple[float, ...]:
        """The numbers one behind the other."""
        head: tuple[Any, ...] = self[:FIRST_WAVE]
        return (*head, *self.waves)


FIRST_WAVE = 5  # numbers before the waves

#: Most waves of one gain set, gravity included; keeps the ACTIVATE command and the cycle bounded.
MAX_WAVES = 17
MAX_SIZE = FIRST_WAVE + 3 * MAX_WAVES


def fits(size: int) -> bool:
    """Whether `size` numbers behind a law's own parameters are a feed-forward as packed here, or none."""
    return size == 0 or (FIRST_WAVE <= size <= MAX_SIZE and (size - FIRST_WAVE) % 3 == 0)


def position_torque(p: PositionTorques, x_ref: float, v_ref: float) -> float:
    """Torque that holds against everything known at the reference position [N*m]."""
    x = x_ref + p.lead * v_ref
    stretch = x - p.spring_rest
    torque = p.offset + (p.spring + p.spring_cubic * stretch * stretch) * stretch
    waves = p.waves
    for i in range(0, len(waves), 3):
        torque += waves[i] * math.sin(waves[i + 1] * x + waves[i + 2])
    return torque
