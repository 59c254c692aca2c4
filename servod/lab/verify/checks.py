"""Every check of a certificate, one function each: figure, limit, margin. Told figures stand in `observations`.

Stands on proof, margins and trials. A check is added to the table at the end and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import CertificateCheck, GainSet
from servod.formats.gains.parameters import LocalParameters
from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws.state import MAY_STAY, STATE_NAMES
from servod.lab.verify.closed_loop import LoopDeviation, corners, inner_points
from servod.lab.verify.margins import NOMINAL, Sweep, arrival_of, largest_tolerated
from servod.lab.verify.plants import drawn
from servod.lab.verify.proof import disc_reach, gain_difference, region_margin, stored_deviation, unproven_rad_s
from servod.lab.verify.rounding import LEAST_COUNTS, NOISE_SWING, count_rad, gives_way_rad, rounding_rad
from servod.lab.verify.sampled import SampledTiming, timing_of
from servod.lab.verify.steady_friction import position_slopes, steady_friction
from servod.lab.verify.trials import (
    ERROR_SHARE,
    RAMP_SHARES,
    RIPPLE_LIMIT_RAD,
    SETTLED_SHARE,
    Sample,
    fastest_rate,
    hold_ripple,
    least_rate,
    monte_carlo,
    quiet,
    ramp_ripples,
    scale_of,
)
from servod.lab.verify.vertices import least_widths, measured_widths

CORNER_SPEEDS, DENSE_SPEEDS, INNER_POINTS = 30, 60, 24
SLOWEST = 1e-3  # share of the top speed
TOP = 1.5  # speeds beyond the map that are judged as well, as a factor
STIFFNESS_LIMIT = 0.8  # of c0: stable with one to three cycles of delay
#: As modelled: gain may err by (2 + 0.1)/(2 - 0.1), +-10 %, and phase by 2*atan(0.05), 6 degrees. An unstable joint on
#: a 1 ms sample leaves no textbook margin; these are what a drive's gain over temperature and a step's jitter take.
DISK_LIMIT = 0.1
#: At a corner every interval is used up to its end, in the worst direction, all at once. What is left has to stand
#: what is in no interval: +-2 % of gain (a drive resolves 0.1 %), 1.1 degrees (at 400 rad/s a cycle 50 us late).
CORNER_DISK = 0.02
POLE_LIMIT = 1.0 - 1e-4  # inside by more than rounding: at 1 ms what goes by a tenth in a second
MOST_NAME = 200
#: Hold: beyond two counts of the encoder and its noise, which no law can tell from motion; stick-slip swings by more.
HOLD_LIMIT_RAD, RAMP_LIMIT_RAD = 2e-5, 2e-4
SAME = 1e-9  # relative difference that writing and reading numbers may make
ONE_CYCLE = 1.5  # cycles of delay up to which one cycle must be stood; commands of two cycles ago, fed back, need two
EXTRA_DELAY_CYCLES, FACTOR_LIMIT = 4.0, 10.0
LIMIT_CYCLE_PLANTS = 4
LEAST_PLANTS = 1000
#: The check that there were so many: the only one that says nothing against a set.
PLANTS_CHECK = "plants of the Monte-Carlo"
#: The check that the design is for the identified axis: no gain mends it.
INTERVALS_CHECK = "identified interval over the design's, the widest"


@dataclass(frozen=True)
class Subject:
    """The set under judgement, with how thoroughly it shall be judged."""

    gains: GainSet
    design: Design
    plants: int
    seed: int
    processes: int
    least_plants: int = LEAST_PLANTS

    @property
    def timing(self) -> SampledTiming:
        """Period, delay, filter and lag that the design states."""
        return timing_of(self.design)

    @property
    def own_cycles(self) -> float:
        """The axis's own delay in cycles, with its lag."""
        return self.timing.as_delay.delay_s / self.timing.period_s

    def cycles(self, count: float) -> SampledTiming:
        """The same loop with a delay of `count` cycles, of which the lag is a part."""
        return replace(self.timing, delay_s=max(count * self.timing.period_s - self.timing.lag_s, 0.0))

    def sweep(self, count: int, also: Iterable[float] = ()) -> Sweep:
        """The linearised law at `count` speeds per direction, and at others."""
        speeds = {*speeds_of(self.design, count), *also}
        friction, local = steady_friction(self.design.model), self.gains.parameters
        arrival = arrival_of(local) if isinstance(local, LocalParameters) else None
        return Sweep(self.gains.law, self.gains.pack(), friction, self.timing, sorted(speeds), arrival)

    @property
    def own_speeds(self) -> list[float]:
        """Where the law's schedules bend, and half-way between: a set is narrow enough to lie between any others."""
        local, low = self.gains.parameters, SLOWEST * self.design.speed_max_rad_s
        if not isinstance(local, LocalParameters):
            return []
        bends = {abs(own.velocity_rad_s) for own in local.friction.sets}
        bends |= {local.regions.overlap_from_rad_s, local.regions.overlap_to_rad_s}
        known = sorted({low} | {v for v in bends if low <= v <= TOP * self.design.speed_max_rad_s})
        return sorted({*known, *(0.5 * (a + b) for a, b in pairwise(known))})

    @cached_property
    def trials(self) -> list[Sample]:
        """The Monte-Carlo's plants, simulated."""
        shaken_rad = self.rounding_rad + self.gives_way_rad
        return monte_carlo(self.gains, self.plants, self.seed, self.processes, shaken_rad)

    @cached_property
    def least_rate_nm_per_s(self) -> float:
        """The slowest change of the torque, of RATES, with which all of LIMIT_CYCLE_PLANTS stand the trial motion."""
        return least_rate(self.gains, LIMIT_CYCLE_PLANTS, self.seed, self.rounding_rad + self.gives_way_rad)

    @cached_property
    def rounding_rad(self) -> float:
        """Peak to peak that the encoder's rounding may make of a joint that creeps as slowly as the ramps."""
        speeds = [share * self.design.speed_max_rad_s for share in RAMP_SHARES]
        return rounding_rad(self.coarse.at(speeds), self.design)

    @property
    def gives_way_rad(self) -> float:
        """Peak to peak by which the torque's noise moves a joint that slides."""
        local = self.gains.parameters
        return gives_way_rad(local, self.design) if isinstance(local, LocalParameters) else 0.0

    @cached_property
    def coarse(self) -> Sweep:
        """The sweep for corners and tolerances."""
        return self.sweep(CORNER_SPEEDS)

    @cached_property
    def dense(self) -> Sweep:
        """The sweep for inner points: dense, and at every bend of the law's schedules."""
        return self.sweep(DENSE_SPEEDS, self.own_speeds)


def speeds_of(design: Design, count: int) -> list[float]:
    """`count` speeds from creeping to beyond the map [rad/s]."""
    top = design.speed_max_rad_s
    return [float(v) for v in np.geomspace(SLOWEST * top, TOP * top, count)]


def at_least(name: str, value: float, limit: float) -> CertificateCheck:
    """A check whose figure must not be below its limit; figures are kept finite."""
    value = float(np.clip(np.nan_to_num(value, nan=-1e12), -1e12, 1e12))
    return CertificateCheck(name=name, value=value, limit=limit, margin=value - limit, passed=bool(value >= limit))


def at_most(name: str, value: float, limit: float) -> CertificateCheck:
    """A check whose figure must not be above its limit."""
    value = float(np.clip(np.nan_to_num(value, nan=1e12), -1e12, 1e12))
    return CertificateCheck(name=name, value=value, limit=limit, margin=limit - value, passed=bool(value <= limit))


def check_seal(s: Subject) -> Iterator[CertificateCheck]:
    """No number was changed since the set was written."""
    yield at_most("numbers changed since the set was sealed (0 no, 1 yes)", float(s.gains.seal_broken), 0.0)


def check_law(s: Subject) -> Iterator[CertificateCheck]:
    """The proofs are of the local law; the gains of another are compared with nothing, and so prove nothing."""
    other = not isinstance(s.gains.parameters, LocalParameters)
    yield at_most("a law that the proofs are not of (0 no, 1 yes)", float(other), 0.0)


def check_regions(s: Subject) -> Iterator[CertificateCheck]:
    """LMIs by eigenvalues; stored vertices as the model says; the law's gains as proven."""
    local = s.gains.parameters
    for region in s.design.regions:
        margin, _ = region_margin(region)
        yield at_least(f"LMI of region {region.name}, least relative eigenvalue", margin, 0.0)
        yield at_most(f"pole discs of region {region.name}, largest |c| + r", disc_reach(region), 1.0)
        yield at_most(f"vertices of region {region.name} against the model", stored_deviation(s.design, region), SAME)
        if isinstance(local, LocalParameters):
            own = getattr(local.regions, region.name)
            difference = gain_difference(own, region, local.input_scale_nm)
            yield at_most(f"gains of region {region.name} against the proven ones", difference, SAME)
            yield at_most(
                f"speeds of region {region.name} that no proof covers [rad/s]",
                unproven_rad_s(local, s.design, region),
                SAME,
            )


def check_intervals(s: Subject) -> Iterator[CertificateCheck]:
    """The design's intervals hold the identified ones, and the least: one relaxed to a narrower world fits no axis."""
    design = s.design.uncertainty.model_dump()
    beyond = {key: width / max(design[key], SAME) for key, width in measured_widths(s.design.model).items()}
    wide = [key for key, ratio in beyond.items() if not ratio <= 1.0 + SAME]
    name = f"{INTERVALS_CHECK}{': ' if wide else ''}{', '.join(wide)}"
    yield at_most(name, float(np.max([0.0, *beyond.values()])), 1.0 + SAME)
    share = {key: design[key] / least if least else 1.0 for key, least in least_widths(s.design.model).items()}
    narrow = [key for key, ratio in share.items() if not ratio >= 1.0 - SAME]
    source = "" if beyond else " (intervals not measured)"
    name = f"design's interval over the least, the narrowest{source}{': ' if narrow else ''}{', '.join(narrow)}"
    yield at_least(name, min(share.values()), 1.0 - SAME)


def check_stiffness(s: Subject) -> Iterator[CertificateCheck]:
    """c0_hat below its stability bound, at the soft end of the interval."""
    local = s.gains.parameters
    if isinstance(local, LocalParameters):
        softest = steady_friction(s.design.model).stiffness * (1.0 - s.design.uncertainty.stiffness)
        share = local.friction.stiffness_nm_per_rad / softest
        yield at_most("c0_hat as a share of the lowest c0", share, STIFFNESS_LIMIT + SAME)


def check_loop(s: Subject) -> Iterator[CertificateCheck]:
    """Largest pole of the full sampled loop: every corner, inner points between nodes and regions, the delay.

    An axis of up to ONE_CYCLE must stand one whole cycle, and two are told. One with more delay must stand its own,
    which the name of the check states, and one cycle is told: its feedback of past commands is for those that wait.
    """
    constant = {i for _, slopes in s.coarse.slopes for i in slopes.frozen}
    name = f"states that a loop lacks, constant in some motion: {', '.join(STATE_NAMES[i] for i in sorted(constant))}"
    yield at_most(name, float(len(constant - MAY_STAY)), 0.0)
    cases = corners(s.design.uncertainty)
    worst = s.coarse.worst(cases)
    yield at_most("largest pole, corners of the intervals", worst.radius, POLE_LIMIT)
    yield at_most("largest pole, corners, without the leak of z_hat's own", worst.coupled_radius, POLE_LIMIT)
    inner = inner_points(s.design.uncertainty, INNER_POINTS, s.seed)
    yield at_most("largest pole, inner points, dense speeds", s.dense.worst(inner).radius, POLE_LIMIT)
    if s.own_cycles <= ONE_CYCLE:
        yield at_most("largest pole, one cycle of delay", s.dense.worst(NOMINAL, s.cycles(1.0)).radius, POLE_LIMIT)
    else:
        name = f"largest pole, the axis's own delay of {s.own_cycles:.2f} cycles"
        yield at_most(name, s.dense.worst(NOMINAL).radius, POLE_LIMIT)
    slopes = position_slopes(s.design.model, s.coarse.friction.gain)
    if any(slopes):
        steepest = [LoopDeviation(position_slope=slope) for slope in slopes]
        yield at_most("largest pole, steepest torque over position", s.coarse.worst(steepest).radius, POLE_LIMIT)
    yield at_least("symmetric disk margin", s.coarse.disk_margin()[0], DISK_LIMIT)
    yield at_least("symmetric disk margin, worst corner of the intervals", s.coarse.disk_margin(cases)[0], CORNER_DISK)


def check_monte_carlo(s: Subject) -> Iterator[CertificateCheck]:
    """Plants drawn from the intervals, simulated with the law that runs: a sine, rest and a large step.

    A few plants say little: a certificate is issued for `least_plants` and more.
    """
    yield at_least(PLANTS_CHECK, float(s.plants), float(s.least_plants))
    sine = f"do not follow a sine through the fall within {ERROR_SHARE:.0%}"
    step = f"do not end a step of {scale_of(s.design).large_rad:.3g} rad within {SETTLED_SHARE:.0%}"
    for what, good in ((sine, "follows"), ("do not come to rest", "rests"), (step, "arrives")):
        failed = sum(not getattr(trial, good) for trial in s.trials)
        yield at_most(f"plants of {len(s.trials)} that {what}", float(failed), 0.0)


def check_rate(s: Subject) -> Iterator[CertificateCheck]:
    """The law gets along with how fast the axis lets its torque change; what it needs is bound by the certificate."""
    own = s.design.torque_rate_nm_per_s or fastest_rate(s.design)
    yield at_most("torque rate that the trial motion needs [N*m/s]", s.least_rate_nm_per_s, own)


def check_limit_cycles(s: Subject) -> Iterator[CertificateCheck]:
    """20 s hold and slow ramps on the model and on drawn plants: first without torque noise, then with it.

    A joint that holds may show two counts of the encoder and its noise, no more: what moves further moves by itself.
    One that slides slowly is moved by its encoder's rounding (`rounding_rad`), and gives way to noise of the torque by
    torque over stiffness; what a ramp swings beyond RAMP_LIMIT_RAD and that is stick-slip.
    """
    plants = (drawn(s.design.model, s.design.uncertainty, s.seed, i) for i in range(LIMIT_CYCLE_PLANTS))
    some = [s.design.model, *plants]
    count = count_rad(s.design)
    still = [quiet(plant, count) for plant in some]
    seen = still[0].noise
    shown = LEAST_COUNTS * count + (NOISE_SWING * seen.encoder_rms if seen else 0.0)
    slides, noisy = RAMP_LIMIT_RAD + s.rounding_rad, RIPPLE_LIMIT_RAD + LEAST_COUNTS * count
    yield at_most("20 s hold, peak to peak [rad]", worst_hold(s, still), HOLD_LIMIT_RAD + shown)
    yield at_most("slow ramps, peak to peak error [rad]", worst_ramp(s, still), slides)
    yield at_most("20 s hold under torque noise, peak to peak [rad]", worst_hold(s, some), noisy)
    ramps = worst_ramp(s, some)
    yield at_most("slow ramps under torque noise, peak to peak [rad]", ramps, slides + s.gives_way_rad)


def worst_hold(s: Subject, plants: list[AxisModel]) -> float:
    """Largest swing of a long hold over `plants` [rad]."""
    return max(hold_ripple(s.gains, s.design, plant) for plant in plants)


def worst_ramp(s: Subject, plants: list[AxisModel]) -> float:
    """Largest peak to peak error of the slow ramps over `plants` [rad]."""
    return max(ripple for plant in plants for ripple in ramp_ripples(s.gains, s.design, plant))


def observations(s: Subject) -> dict[str, float]:
    """Figures that are told and not judged: other delays, the worst plants, and how far one value alone may go."""
    sweep, period = s.coarse, s.design.period_s
    told = {"two cycles": 2.0} | ({"one cycle": 1.0} if s.own_cycles > ONE_CYCLE else {})
    delays = {f"largest pole, {name} of delay": s.dense.worst(NOMINAL, s.cycles(n)).radius for name, n in told.items()}
    longest = largest_tolerated(lambda d: sweep.stable(LoopDeviation(), d), 0.0, EXTRA_DELAY_CYCLES * period)
    return {
        **sweep.classical_margins(),
        **delays,
        "largest error on the sine over the plants [share]": max(trial.error_share for trial in s.trials),
        "largest rest of the large step over the plants [share]": max(trial.unsettled_share for trial in s.trials),
        "largest swing at rest over the plants [share of the step]": max(trial.ripple_share for trial in s.trials),
        "largest tolerated delay [s]": s.timing.as_delay.delay_s + longest,
        "largest tolerated friction scale": largest_tolerated(
            lambda f: sweep.stable(LoopDeviation(dry=f, viscous=f)), 1.0, FACTOR_LIMIT
        ),
        "largest tolerated inertia scale": largest_tolerated(
            lambda f: sweep.stable(LoopDeviation(inertia=f)), 1.0, FACTOR_LIMIT
        ),
        "least tolerated inertia scale": largest_tolerated(lambda f: sweep.stable(LoopDeviation(inertia=f)), 1.0, 0.1),
    }


#: Cheap ones first: a set that fails them is not simulated.
STATIC: tuple[Callable[[Subject], Iterator[CertificateCheck]], ...] = (
    check_seal,
    check_law,
    check_regions,
    check_stiffness,
    check_intervals,
    check_loop,
)
SIMULATED = (check_monte_carlo, check_rate, check_limit_cycles)
