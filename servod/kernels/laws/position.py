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

# Where each number stands, counted from the first one behind the law's own parameters.
LEAD = 0  # time by which the reference position is led [s]
OFFSET = 1  # constant torque [N*m]
SPRING = 2  # stiffness [N*m/rad]
SPRING_REST = 3  # position without torque [rad]
SPRING_CUBIC = 4  # [N*m/rad^3]
FIRST_WAVE = 5  # then, to the end, amplitude [N*m], n [1/rad] and phase [rad] of amplitude*sin(n*x + phase)

#: Most waves of one gain set, gravity included; keeps the ACTIVATE command and the cycle bounded.
MAX_WAVES = 17
MAX_SIZE = FIRST_WAVE + 3 * MAX_WAVES


def fits(size: int) -> bool:
    """Whether `size` numbers behind a law's own parameters are a feed-forward as packed here, or none."""
    return size == 0 or (FIRST_WAVE <= size <= MAX_SIZE and (size - FIRST_WAVE) % 3 == 0)


def position_torque(p: Sequence[float], first: int, x_ref: float, v_ref: float) -> float:
    """Torque that holds against everything known at the reference position [N*m]; its numbers start at p[first]."""
    x = x_ref + p[first + LEAD] * v_ref
    stretch = x - p[first + SPRING_REST]
    torque = p[first + OFFSET] + (p[first + SPRING] + p[first + SPRING_CUBIC] * stretch * stretch) * stretch
    for i in range(first + FIRST_WAVE, len(p), 3):
        torque += p[i] * math.sin(p[i + 1] * x + p[i + 2])
    return torque
