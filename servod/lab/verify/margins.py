"""What the full sampled loop tolerates: worst poles over points and intervals, disk margin, delay, friction, inertia.

Stands on `closed_loop`. A sweep linearises the law once per velocity and judges many joints under it at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.formats.gains.parameters import LocalParameters
from servod.kernels.laws import Law
from servod.lab.verify.closed_loop import (
    LinearBristle,
    LoopDeviation,
    joint_points,
    loops_around,
    sampled_points,
    spectral_radius,
)
from servod.lab.verify.law_slopes import LawSlopes, arriving_slopes, law_slopes
from servod.lab.verify.sampled import Array, SampledTiming
from servod.lab.verify.steady_friction import SteadyFriction

FREQUENCIES = 200
ON_CIRCLE = np.exp(1j * np.geomspace(1e-3, np.pi, FREQUENCIES))
SEARCH_STEPS = 14
NOMINAL = (LoopDeviation(),)
BEYOND_HOLD = 4.0  # widths of holding, at which a joint has not arrived yet
LEAST_ERROR_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class Worst:
    """The worst pole of a sweep, and where it is; `coupled_radius` leaves out what goes by itself, as z_hat's leak."""

    radius: float
    coupled_radius: float
    velocity_rad_s: float
    bristle: str
    case: int


@dataclass(frozen=True, slots=True)
class Judgement:
    """Largest pole and least disk margin of a sweep; `hardest` are the cases worst in either at some velocity."""

    radius: float
    radius_at_rad_s: float
    disk_margin: float
    disk_at_rad_s: float
    hardest: list[LoopDeviation]


@lru_cache(maxsize=1024)
def joints_at(
    friction: SteadyFriction,
    velocity: float,
    bristle: LinearBristle,
    cases: tuple[LoopDeviation, ...],
    timing: SampledTiming,
) -> tuple[Array, Array, int]:
    """`sampled_points` in each case: the same for every law, and most of the work of a sweep."""
    return sampled_points(joint_points(friction, velocity, bristle, cases), timing)


@dataclass(frozen=True, slots=True)
class Arrival:
    """How a joint arrives where its law is another one then: this far from its resting reference, slower than this."""

    error_rad: float
    below_rad_s: float


def arrival_of(law: LocalParameters) -> Arrival | None:
    """Arrival under a law with an observer of its own for it; None where a joint arrives as it moves."""
    observer = law.disturbance_observer
    if observer is None or observer.low_bandwidth_rad_s in (None, observer.bandwidth_rad_s):
        return None
    beyond = BEYOND_HOLD * max(law.hold_within_rad, law.rest_within_rad or 0.0, LEAST_ERROR_RAD)
    return Arrival(beyond, law.regions.overlap_to_rad_s)


class Sweep:
    """One law on one axis, to be judged at many velocities; `speeds` ascend, both directions are taken."""

    def __init__(
        self,
        law: Law,
        gains: tuple[float, ...],
        friction: SteadyFriction,
        timing: SampledTiming,
        speeds: Sequence[float],
        arrival: Arrival | None = None,
    ) -> None:
        self.law, self.gains, self.friction, self.timing = law, gains, friction, timing
        self.speeds, self.arrival = tuple(speeds), arrival

    def at(self, speeds: Sequence[float]) -> Sweep:
        """The same law on the same axis at other speeds."""
        return Sweep(self.law, self.gains, self.friction, self.timing, speeds, self.arrival)

    @cached_property
    def slopes(self) -> list[tuple[float, LawSlopes]]:
        """The linearised law: moving through zero, holding, at every velocity in both directions, and arriving."""
        rest = [(0.0, law_slopes(self.law, self.gains, 0.0, moves, self.timing)) for moves in (True, False)]
        velocities = [side * v for side in (1.0, -1.0) for v in self.speeds]
        moving = [(v, law_slopes(self.law, self.gains, v, True, self.timing)) for v in velocities]
        return rest + moving + self._arriving(velocities)

    def _arriving(self, velocities: Sequence[float]) -> list[tuple[float, LawSlopes]]:
        """The same where the joint comes to rest: sticking, and creeping at every velocity that is slow enough."""
        if self.arrival is None:
            return []
        slow = [0.0, *(v for v in velocities if abs(v) < self.arrival.below_rad_s)]
        return [(v, arriving_slopes(self.law, self.gains, v, self.arrival.error_rad, self.timing)) for v in slow]

    @cached_property
    def coupled(self) -> list[tuple[float, LawSlopes]]:
        """The same without the states of the law that go by themselves."""
        return [(velocity, slopes.coupled()) for velocity, slopes in self.slopes]

    @cached_property
    def own_radius(self) -> float:
        """Largest pole of what goes by itself in the law; 0.0 where nothing does."""
        return max((abs(pole) for _, slopes in self.slopes for pole in slopes.autonomous.values()), default=0.0)

    def systems(
        self, cases: Sequence[LoopDeviation], timing: SampledTiming | None = None, *, transient: bool = True
    ) -> Iterator[tuple[float, LinearBristle, tuple[Array, Array, Array]]]:
        """Closed loops of `cases` of one delay at each velocity; `transient`: also with the bristle not yet following.

        Without the states of the law that go by themselves; `own_radius` has their poles.
        """
        own = timing or self.timing
        late, known = own.later_by(cases[0].delay_s), tuple(cases)
        for velocity, slopes in self.coupled:
            kinds = [LinearBristle.STICKS] if velocity == 0.0 else [LinearBristle.SLIDES]
            if transient and velocity != 0.0:
                kinds += [LinearBristle.STICKS, LinearBristle.TURNS]
            for kind in kinds:
                yield velocity, kind, loops_around(*joints_at(self.friction, velocity, kind, known, late), slopes)

    def worst(self, cases: Sequence[LoopDeviation], timing: SampledTiming | None = None) -> Worst:
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

    def disk_margin(self, cases: Sequence[LoopDeviation] = NOMINAL) -> tuple[float, float]:
        """(symmetric disk margin, velocity where it is least), least over `cases`; the joint as modelled by default.

        alpha = 2/max|S - T| over the frequencies: gain may change by (2 + alpha)/(2 - alpha) and phase by
        2*atan(alpha/2) at the drive. Source: Seiler, Packard, Gahinet, IEEE Control Systems 40(5), 2020.
        """
        least, where = np.inf, 0.0
        for group in by_delay(cases):
            for velocity, _, (closed, column, row) in self.systems([cases[i] for i in group], transient=False):
                margin = float(disk_margins(sensitivity(closed, column, row)).min())
                if margin < least:
                    least, where = margin, velocity
        return least, where

    def classical_margins(self) -> dict[str, float]:
        """MARGINS of the joint as modelled by their keys, each the least (peak sensitivity: the largest) over all
        velocities; one that no frequency bounds is left out."""
        found: dict[str, list[float]] = {key: [] for key in MARGINS}
        for _, _, (closed, column, row) in self.systems(NOMINAL, transient=False):
            response = sensitivity(closed, column, row, on_circle=FINE_CIRCLE)[0]
            for key, value in classical_margins(1.0 / response - 1.0, np.angle(FINE_CIRCLE)).items():
                found[key].append(value)
        worst = {key: (max if key == PEAK else min)(values, default=np.inf) for key, values in found.items()}
        return {key: float(value) for key, value in worst.items() if np.isfinite(value)}

    def judge(self, cases: Sequence[LoopDeviation]) -> Judgement:
        """Poles and disk margin of `cases` at once, for a search: what `worst` and `disk_margin` say."""
        found, hardest = Judgement(self.own_radius, 0.0, np.inf, 0.0, []), set()
        for group in by_delay(cases):
            for velocity, kind, (closed, column, row) in self.systems([cases[i] for i in group]):
                poles = np.linalg.eigvals(closed)
                radius = np.abs(poles).max(axis=-1)
                hardest.add(group[int(radius.argmax())])
                if radius.max() > found.radius:
                    found = replace(found, radius=float(radius.max()), radius_at_rad_s=velocity)
                if kind is LinearBristle.SLIDES or velocity == 0.0:
                    margin = disk_margins(sensitivity(closed, column, row, poles))
                    hardest.add(group[int(margin.argmin())])
                    if margin.min() < found.disk_margin:
                        found = replace(found, disk_margin=float(margin.min()), disk_at_rad_s=velocity)
        return replace(found, hardest=[cases[i] for i in sorted(hardest)])

    def stable(self, case: LoopDeviation, extra_delay_s: float = 0.0) -> bool:
        """Whether all poles are inside, steady sliding and sticking, for one case and a longer delay."""
        timing = self.timing.later_by(extra_delay_s)
        systems = self.systems((case,), timing, transient=False)
        return self.own_radius < 1.0 and all(spectral_radius(closed)[0] < 1.0 for _, _, (closed, _, _) in systems)


def by_delay(cases: Sequence[LoopDeviation]) -> list[list[int]]:
    """Numbers of the cases in groups of one delay, with a spring or without: only these have the same states."""
    kinds = [(case.delay_s, case.behind is None) for case in cases]
    return [[i for i, kind in enumerate(kinds) if kind == one] for one in dict.fromkeys(kinds)]


def sensitivity(
    closed: Array,
    column: Array,
    row: Array,
    poles: NDArray[Any] | None = None,
    on_circle: NDArray[np.complex128] = ON_CIRCLE,
) -> NDArray[np.complex128]:
    """S of each closed loop at the drive over `on_circle` up to half the sample rate, from its `poles` if known.

    S(z) = det(z - A_open)/det(z - A_closed): the zeros of S are the poles of the open loop.
    """
    known = np.linalg.eigvals(closed) if poles is None else poles
    zeros = np.linalg.eigvals(closed - column[:, :, None] * row)
    above = np.ones((len(closed), len(on_circle)), dtype=np.complex128)
    below = np.ones_like(above)
    for zero, pole in zip(zeros.T, known.T, strict=True):  # one root of all loops at a time: no array in all three
        above *= on_circle - zero[:, None]
        below *= on_circle - pole[:, None]
    response: NDArray[np.complex128] = above / below
    return response


def disk_margins(response: NDArray[np.complex128]) -> Array:
    """Symmetric disk margin 1/max|S - 1/2| of each response of S."""
    margins: Array = 1.0 / np.abs(response - 0.5).max(axis=1)
    return margins


# --- Classical margins -----------------------------------------------------------------------------------------------
# What control engineers read first: gain, phase, delay and Ms, one at a time, from the frequency response of the loop
# that is opened at the drive's torque command.


class MarginWords(NamedTuple):
    """How a margin reads; `usual` is what textbooks ask of a loop (Astrom, Murray: Feedback Systems, ch. 10)."""

    name: str
    unit: str
    meaning: str
    usual: str


UP, DOWN, PHASE, DELAY = "gain margin up [dB]", "gain margin down [dB]", "phase margin [deg]", "delay margin [cycles]"
PEAK = "peak sensitivity Ms"
#: Margins by their keys in the observations of a certificate.
MARGINS = {
    UP: MarginWords("gain margin upward", "dB", "so much more gain from command to torque it still stands", "6"),
    DOWN: MarginWords("gain margin downward", "dB", "so much less gain, where friction destabilises the joint", "6"),
    PHASE: MarginWords("phase margin", "°", "so much more phase lag, or less, where the gain is one", "30 to 60"),
    DELAY: MarginWords("delay margin", "cycles", "so much more delay from command to torque", "1"),
    PEAK: MarginWords("peak sensitivity Ms", "", "largest |S|; 1/Ms is the least distance of L to -1", "at most 2"),
}
#: Frequencies in rad a sample, closely enough that a crossing between two is a straight line.
FINE_CIRCLE = np.exp(1j * np.geomspace(1e-4, np.pi, 4000))


def classical_margins(loop: NDArray[np.complex128], angle: Array) -> dict[str, float]:
    """MARGINS of one stable closed loop from L, sampled at `angle` [rad a sample], up to half the sample rate.

    L is that of 1 + L = 0: gain margins where the phase is -180 degrees, the others where |L| = 1;
    Ms = max |1/(1 + L)|. Between two frequencies log |L| and phase are straight lines. A delay margin counts the phase
    down to -180 degrees from above, whatever lies between. inf: no such crossing.
    """
    size, phase = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    crossed = _crossings(size)
    lag, omega = _between(phase, crossed) + np.pi, _between(angle, crossed)
    turned = _crossings(np.sin(phase))
    negative = np.cos(_between(phase, turned)) < 0.0
    gains = list(20.0 / np.log(10.0) * _between(size, turned)[negative])
    level = abs(size[1] - size[0]) < 0.1 * np.log(angle[1] / angle[0])  # no integrator
    ends = [loop[0]] * bool(level and loop[0].real < 0.0) + [loop[-1]] * bool(loop[-1].real < 0.0)
    gains += [20.0 * float(np.log10(abs(end))) for end in ends]  # at rest and at half the sample rate L is real
    wrapped = np.abs((lag + np.pi) % (2.0 * np.pi) - np.pi)
    return {
        UP: min((-g for g in gains if g < 0.0), default=np.inf),
        DOWN: min((g for g in gains if g > 0.0), default=np.inf),
        PHASE: float(np.degrees(wrapped.min(initial=np.inf))),
        DELAY: float(((lag % (2.0 * np.pi)) / omega).min(initial=np.inf)),
        PEAK: float((1.0 / np.abs(1.0 + loop)).max()),
    }


def _crossings(values: Array) -> Array:
    """(place, share of the step behind it) of every change of sign."""
    at = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return np.array([at, values[at] / (values[at] - values[at + 1])])


def _between(values: Array, crossed: Array) -> Array:
    """`values` at crossings, on a straight line."""
    at = crossed[0].astype(np.intp)
    found: Array = values[at] + crossed[1] * (values[at + 1] - values[at])
    return found


def describe_margins(observations: Mapping[str, float]) -> str:
    """The margins of a certificate in one clause; empty where it states none."""
    told = [
        f"{words.name} {observations[key]:.3g} {words.unit}".rstrip()
        for key, words in MARGINS.items()
        if key in observations
    ]
    return ", ".join(told).replace(" °", "°")


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
