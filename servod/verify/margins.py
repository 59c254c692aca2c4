"""What the full sampled loop tolerates: worst poles over points and intervals, disk margin, delay, friction, inertia.

Stands on `closed_loop`. A sweep linearises the law once per velocity and judges many joints under it at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servod.controllers import Law
from servod.verify.closed_loop import Bristle, Deviation, LawSlopes, joint_point, law_slopes, loops, spectral_radius
from servod.verify.sampled import Array, Timing
from servod.verify.steady_friction import SteadyFriction

FREQUENCIES = 200
SEARCH_STEPS = 14
NOMINAL = (Deviation(),)


@dataclass(frozen=True, slots=True)
class Worst:
    """The worst pole of a sweep, and where it is; `coupled_radius` leaves out what goes by itself, as z_hat's leak."""

    radius: float
    coupled_radius: float
    velocity_rad_s: float
    bristle: str
    case: int


class Sweep:
    """One law on one axis, to be judged at many velocities; `speeds` ascend, both directions are taken."""

    def __init__(
        self, law: Law, gains: tuple[float, ...], friction: SteadyFriction, timing: Timing, speeds: Sequence[float]
    ) -> None:
        self.law, self.gains, self.friction, self.timing = law, gains, friction, timing
        self.speeds = tuple(speeds)

    @cached_property
    def slopes(self) -> list[tuple[float, LawSlopes]]:
        """The linearised law: moving through zero, holding at rest, and at every velocity in both directions."""
        rest = [(0.0, law_slopes(self.law, self.gains, 0.0, moves, self.timing)) for moves in (True, False)]
        velocities = [side * v for side in (1.0, -1.0) for v in self.speeds]
        return rest + [(v, law_slopes(self.law, self.gains, v, True, self.timing)) for v in velocities]

    @cached_property
    def coupled(self) -> list[tuple[float, LawSlopes]]:
        """The same without the states of the law that go by themselves."""
        return [(velocity, slopes.coupled()) for velocity, slopes in self.slopes]

    @cached_property
    def own_radius(self) -> float:
        """Largest pole of what goes by itself in the law; 0.0 where nothing does."""
        return max((abs(pole) for _, slopes in self.slopes for pole in slopes.autonomous.values()), default=0.0)

    def systems(
        self, cases: Sequence[Deviation], timing: Timing | None = None, *, transient: bool = True
    ) -> Iterator[tuple[float, Bristle, tuple[Array, Array, Array]]]:
        """Closed loops of `cases` of one delay at each velocity; `transient`: also with the bristle not yet following.

        Without the states of the law that go by themselves; `own_radius` has their poles.
        """
        late = replace(timing or self.timing, delay_s=(timing or self.timing).delay_s + cases[0].delay_s)
        for velocity, slopes in self.coupled:
            kinds = [Bristle.STICKS] if velocity == 0.0 else [Bristle.SLIDES]
            if transient and velocity != 0.0:
                kinds += [Bristle.STICKS, Bristle.TURNS]
            for kind in kinds:
                points = [joint_point(self.friction, velocity, kind, case) for case in cases]
                yield velocity, kind, loops(points, slopes, late)

    def worst(self, cases: Sequence[Deviation], timing: Timing | None = None) -> Worst:
        """The worst pole over all velocities, bristle states and cases."""
        found = Worst(self.own_radius, 0.0, 0.0, "", 0)
        for group in by_delay(cases):
            for velocity, kind, (closed, _, _) in self.systems([cases[i] for i in group], timing):
                radius = spectral_radius(closed)
                i = int(radius.argmax())
                if radius[i] > found.coupled_radius:
                    largest = max(float(radius[i]), self.own_radius)
                    found = Worst(largest, float(radius[i]), velocity, kind.name.lower(), group[i])
        return found

    def disk_margin(self, cases: Sequence[Deviation] = NOMINAL) -> tuple[float, float]:
        """(symmetric disk margin, velocity where it is least), least over `cases`; the joint as modelled by default.

        alpha = 2/max|S - T| over the frequencies: gain may change by (2 + alpha)/(2 - alpha) and phase by
        2*atan(alpha/2) at the drive. Source: Seiler, Packard, Gahinet, IEEE Control Systems 40(5), 2020.
        """
        least, where = np.inf, 0.0
        for group in by_delay(cases):
            for velocity, _, (closed, column, row) in self.systems([cases[i] for i in group], transient=False):
                worst = float(np.abs(sensitivity(closed, column, row) - 0.5).max())
                if 1.0 / worst < least:
                    least, where = 1.0 / worst, velocity
        return least, where

    def stable(self, case: Deviation, extra_delay_s: float = 0.0) -> bool:
        """Whether all poles are inside, steady sliding and sticking, for one case and a longer delay."""
        timing = replace(self.timing, delay_s=self.timing.delay_s + extra_delay_s)
        systems = self.systems((case,), timing, transient=False)
        return self.own_radius < 1.0 and all(spectral_radius(closed)[0] < 1.0 for _, _, (closed, _, _) in systems)


def by_delay(cases: Sequence[Deviation]) -> list[list[int]]:
    """Numbers of the cases in groups of one delay, with a spring or without: only these have the same states."""
    kinds = [(case.delay_s, case.behind is None) for case in cases]
    return [[i for i, kind in enumerate(kinds) if kind == one] for one in dict.fromkeys(kinds)]


def sensitivity(closed: Array, column: Array, row: Array) -> NDArray[np.complex128]:
    """S of each closed loop at the drive over FREQUENCIES up to half the sample rate, from the poles.

    S(z) = det(z - A_open)/det(z - A_closed): the zeros of S are the poles of the open loop.
    """
    z = np.exp(1j * np.geomspace(1e-3, np.pi, FREQUENCIES))[None, :, None]
    poles = np.linalg.eigvals(closed)[:, None, :]
    zeros = np.linalg.eigvals(closed - column[:, :, None] * row)[:, None, :]
    response: NDArray[np.complex128] = np.prod((z - zeros) / (z - poles), axis=2)
    return response


def largest_tolerated(stable: Callable[[float], bool], start: float, end: float) -> float:
    """Largest value between `start` and `end` with all stable from `start` on, by bisection; `start` if none."""
    if not stable(start):
        return start
    if stable(end):
        return end
    good, bad = start, end
    for _ in range(SEARCH_STEPS):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if stable(middle) else (good, middle)
    return good
