"""The mix of a trial: how many cases of which kind, with which effects, hidden in which way; shuffled.

Stands above the drawings and below the cases.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain, cycle, islice

import numpy as np

from servod.qualify.blind import listed
from servod.qualify.blind.axes import CaseKind
from servod.qualify.blind.engine import CONCEALS
from servod.qualify.blind.hidden import HIDE, UNLISTED


class Sort(StrEnum):
    """What kind of answer is right."""

    SINGLE = "single"
    PAIR = "pair"
    NOTHING = "nothing"
    UNKNOWN = "unknown"


class Cover(StrEnum):
    """What hides an effect beside noise and a model that is a little off."""

    NONE = "none"
    INTEGRATOR = "integrator"  # the controller has one
    BAND = "band"  # acts at the highest tones alone
    NOISE = "noise"  # smaller than the noise of a single run
    ABSORBED = "absorbed"  # the model's friction has taken up what it could


#: Shares of the cases.
MIX = {Sort.SINGLE: 0.5, Sort.PAIR: 0.2, Sort.NOTHING: 0.18, Sort.UNKNOWN: 0.12}

#: Covers in turn, and the effects that some of them suit.
COVERS = (Cover.NONE, Cover.INTEGRATOR, Cover.NONE, Cover.BAND, Cover.NONE, Cover.NOISE, Cover.NONE, Cover.ABSORBED)
IN_A_BAND = {listed.JOINT_ELASTICITY, listed.DELAY, listed.ACTUATOR_LAG}
ABSORBABLE = {
    *(listed.VISCOUS_NONLINEAR, listed.LOAD_DEPENDENT_FRICTION, listed.POSITION_DEPENDENT_FRICTION),
    *(listed.THERMAL, listed.TORQUE_GAIN, listed.ASYMMETRY),
}

#: Effects that act in the same way, so that no data tell two of them apart; pairs take theirs from different rows.
FAMILIES = (
    (listed.STRIBECK, listed.PRESLIDING),
    (listed.ASYMMETRY, listed.TORQUE_OFFSET, listed.DISTURBANCE),
    (listed.VISCOUS_NONLINEAR, listed.TORQUE_SATURATION, listed.THERMAL),
    (listed.LOAD_DEPENDENT_FRICTION, listed.POSITION_DEPENDENT_FRICTION),
    (listed.COGGING, listed.TORQUE_RIPPLE),
    (listed.GRAVITY, listed.SPRING),
    (listed.DELAY, listed.ACTUATOR_LAG, listed.JOINT_ELASTICITY, listed.BACKLASH),
    (listed.INERTIA, listed.TORQUE_GAIN, listed.POSITION_DEPENDENT_INERTIA, listed.ENCODER_ECCENTRICITY),
)

#: Pairs of different rows that act alike all the same.
ALIKE = (
    {listed.TORQUE_GAIN, listed.VISCOUS_NONLINEAR},
    {listed.TORQUE_GAIN, listed.TORQUE_SATURATION},
    {listed.TORQUE_GAIN, listed.LOAD_DEPENDENT_FRICTION},
    {listed.POSITION_DEPENDENT_INERTIA, listed.JOINT_ELASTICITY},
    {listed.POSITION_DEPENDENT_INERTIA, listed.BACKLASH},
    {listed.INERTIA, listed.JOINT_ELASTICITY},
    {listed.INERTIA, listed.BACKLASH},
    {listed.ENCODER_ECCENTRICITY, listed.JOINT_ELASTICITY},
    {listed.ENCODER_ECCENTRICITY, listed.BACKLASH},
    {listed.PRESLIDING, listed.BACKLASH},
    {listed.PRESLIDING, listed.JOINT_ELASTICITY},
    {listed.TORQUE_RIPPLE, listed.POSITION_DEPENDENT_INERTIA},
    {listed.GRAVITY, listed.TORQUE_OFFSET},
    {listed.SPRING, listed.TORQUE_OFFSET},
    {listed.LOAD_DEPENDENT_FRICTION, listed.TORQUE_SATURATION},
)


class Engine(StrEnum):
    """Who moves the axes of a trial."""

    OWN = "own"  # the trial's plant
    MUJOCO = "mujoco"


@dataclass(frozen=True)
class Settings:
    """How hard a trial is: share of cases whose plant has other forms, 1 % of other effects, factor on the noise.

    `engine` moves the axes, and conceals what it has means for.
    """

    other_forms: float = 0.25
    clutter: bool = False
    noise: float = 1.0
    engine: Engine = Engine.OWN


HARDER = Settings(other_forms=1.0, clutter=True, noise=4.0)


def settings_of(harder: bool, engine: Engine) -> Settings:
    """The settings of a trial. MuJoCo knows no other forms than its own; the harder trial has four times the noise."""
    if engine is Engine.MUJOCO:
        return Settings(other_forms=0.0, noise=HARDER.noise if harder else 1.0, engine=engine)
    return HARDER if harder else Settings()


@dataclass(frozen=True)
class CaseSpec:
    """One case to be made."""

    sort: Sort
    effects: tuple[str, ...]
    kind: CaseKind
    cover: Cover
    off: bool
    other: bool
    weight: bool
    seed: int


def plans(cases: int, seed: int, settings: Settings, null: int = 0) -> list[CaseSpec]:
    """The cases of a trial and `null` more that conceal nothing, in an order that tells nothing."""
    rng = np.random.default_rng(seed)
    covers = islice(cycle(COVERS), int(rng.integers(len(COVERS))), None)
    made = []
    nothing: Iterator[tuple[Sort, tuple[str, ...]]] = ((Sort.NOTHING, ()) for _ in range(null))
    for number, (sort, effects) in enumerate(chain(contents(cases, rng, settings.engine), nothing)):
        other = sort in {Sort.SINGLE, Sort.PAIR} and bool(rng.uniform() < settings.other_forms)
        kind, weight = list(CaseKind)[int(rng.integers(3))], bool(rng.uniform() < 0.3)
        cover = suited(next(covers), sort, effects)
        made.append(CaseSpec(sort, effects, kind, cover, number % 2 == 1, other, weight, int(rng.integers(2**31))))
    return [made[i] for i in rng.permutation(len(made))]


def contents(
    cases: int, rng: np.random.Generator, engine: Engine = Engine.OWN
) -> Iterator[tuple[Sort, tuple[str, ...]]]:
    """Kind and effects of every case; names come in turn, so that none is missed. MuJoCo knows no unlisted physics."""
    names, own = (CONCEALS, False) if engine is Engine.MUJOCO else (tuple(HIDE), True)
    counts = {sort: round(share * cases) for sort, share in MIX.items() if own or sort is not Sort.UNKNOWN}
    counts[Sort.SINGLE] += cases - sum(counts.values())
    singles, unlisted = _in_turn(names, rng), _in_turn(list(UNLISTED), rng)
    for _ in range(counts[Sort.SINGLE]):
        yield Sort.SINGLE, (next(singles),)
    for _ in range(counts[Sort.PAIR]):
        yield Sort.PAIR, pair(rng, names)
    for _ in range(counts[Sort.NOTHING]):
        yield Sort.NOTHING, ()
    for _ in range(counts.get(Sort.UNKNOWN, 0)):
        yield Sort.UNKNOWN, (next(unlisted),)


def _in_turn(names: Sequence[str], rng: np.random.Generator) -> Iterator[str]:
    while True:
        yield from (names[i] for i in rng.permutation(len(names)))


def pair(rng: np.random.Generator, names: Container[str]) -> tuple[str, str]:
    """Two effects among `names` that good data can tell apart."""
    while True:
        first, second = rng.choice(len(FAMILIES), 2, replace=False)
        one, other = (str(rng.choice(FAMILIES[i])) for i in (first, second))
        if {one, other} not in ALIKE and one in names and other in names:
            return one, other


def suited(cover: Cover, sort: Sort, effects: tuple[str, ...]) -> Cover:
    """The cover if it can hide these effects; an integrator hides anything."""
    if cover is Cover.BAND and not set(effects) & IN_A_BAND:
        return Cover.NONE
    if cover is Cover.ABSORBED and not set(effects) & ABSORBABLE:
        return Cover.INTEGRATOR
    if cover is Cover.NOISE and sort is not Sort.SINGLE:
        return Cover.NONE
    return cover
