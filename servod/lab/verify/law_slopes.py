"""A control law linearised around steady motion: its own step function, differentiated numerically as it is.

Under the closed loop; whatever a law has in it is in its slopes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from servod.kernels.laws import Law
from servod.kernels.laws.state import N_STATES, STATES, LawState
from servod.lab.verify.sampled import Array, SampledTiming

SETTLE_CYCLES = 100  # at most, after the first long one
LONG_S = 1e4  # the friction state's step is exact, so one long cycle settles it
NUDGE = 1e-7
#: Of a law's state, in order; dataclasses.astuple copies every number.
_values = attrgetter(*STATES)


@dataclass(frozen=True, slots=True)
class LawSlopes:
    """The law linearised: [u, next law state] = matrix times [x, v_f, law state]; `frozen` states never change."""

    matrix: Array
    frozen: tuple[int, ...]

    @property
    def autonomous(self) -> dict[int, float]:
        """States that go by themselves, seeing neither joint nor other states, with their pole: a leak of z_hat.

        The reference drives them, the loop does not, so their pole says nothing of how well the loop is damped.
        """
        found = {}
        for i in range(N_STATES):
            row, own = self.matrix[1 + i].copy(), float(self.matrix[1 + i, 2 + i])
            row[2 + i] = 0.0
            if i not in self.frozen and own != 0.0 and np.allclose(row, 0.0, atol=1e-12):
                found[i] = own
        return found

    def coupled(self) -> LawSlopes:
        """The same without the states that go by themselves: the loop's other poles, and its frequency response."""
        return replace(self, frozen=(*self.frozen, *self.autonomous))


def settled_state(law: Law, gains: tuple[float, ...], velocity: float, moves: bool, period_s: float) -> LawState:
    """State of the law in steady motion without error: what it settles to when fed its own torque."""
    p, state = law.named(gains), LawState(last_velocity=velocity)
    nudge = np.finfo(float).tiny if moves else 0.0
    for cycle in range(SETTLE_CYCLES):
        before = _values(state)
        dt = period_s if cycle else LONG_S
        law.step(p, state, 0.0, velocity, nudge, 0.0, velocity, state.asked, dt)
        if max(abs(x - y) for x, y in zip(before, _values(state), strict=True)) < 1e-15:
            break
    return state


def law_slopes(law: Law, gains: tuple[float, ...], velocity: float, moves: bool, timing: SampledTiming) -> LawSlopes:
    """Slopes at steady motion with the reference; at rest `moves` tells crossing zero from holding."""
    base = settled_state(law, gains, velocity, moves, timing.period_s)
    nudge = np.finfo(float).tiny if moves else 0.0
    return _differences(law, gains, base, (0.0, velocity, nudge, velocity), timing)


def arriving_slopes(
    law: Law, gains: tuple[float, ...], velocity: float, error_rad: float, timing: SampledTiming, rest: float = 0.0
) -> LawSlopes:
    """Slopes where the reference rests and the joint slides `error_rad` away from it.

    `rest`: how far it counts as at rest, from 0, as on its way there, to 1, as when it stood and was pushed.
    """
    base = LawState(last_velocity=velocity, started=1.0, rest=rest)
    return _differences(law, gains, base, (error_rad, 0.0, 0.0, velocity), timing)


def _differences(
    law: Law, gains: tuple[float, ...], base: LawState, around: tuple[float, float, float, float], timing: SampledTiming
) -> LawSlopes:
    """Central differences of the law's step around (error, reference's velocity and acceleration, velocity)."""
    error, v_ref, a_ref, velocity = around
    p, start = law.named(gains), _values(base)
    scale = np.full(N_STATES, NUDGE)
    scale[STATES.index("z_hat")] = NUDGE * max(abs(base.z_hat), 1e-4)

    def stepped(x: float, v: float, shift: Array) -> Array:
        state = LawState(*(value + float(extra) for value, extra in zip(start, shift, strict=True)))
        u = law.step(p, state, error, v_ref, a_ref, x, velocity + v, state.asked, timing.period_s)[0]
        return np.array([u, *_values(state)])

    still, dx = np.zeros(N_STATES), max(1e-10, NUDGE * abs(error))
    columns = [
        (stepped(dx, 0.0, still) - stepped(-dx, 0.0, still)) / (2.0 * dx),
        (stepped(0.0, NUDGE, still) - stepped(0.0, -NUDGE, still)) / (2.0 * NUDGE),
    ]
    for i in range(N_STATES):
        shift = np.zeros(N_STATES)
        shift[i] = scale[i]
        columns.append((stepped(0.0, 0.0, shift) - stepped(0.0, 0.0, -shift)) / (2.0 * scale[i]))
    matrix = np.stack(columns, axis=1)
    unit = np.eye(N_STATES)
    frozen = tuple(i for i in range(N_STATES) if np.allclose(matrix[1 + i], [0.0, 0.0, *unit[i]], atol=1e-9))
    return LawSlopes(matrix, frozen)
