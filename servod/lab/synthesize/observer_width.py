"""How fast the output observer may be: the widest bandwidth that the full sampled loop stands, in either region.

Stands on the sweep that verification uses, between the feedback that the LMIs gave and the gain set. A search judges
all corners at few speeds, and at many speeds those corners that were the worst somewhere; verification judges all.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters, VelocitySource
from servod.kernels.laws import LAWS
from servod.lab.verify.checks import CORNER_DISK, CORNER_SPEEDS, DISK_LIMIT, Subject, speeds_of
from servod.lab.verify.closed_loop import LoopDeviation, corners, late_corners
from servod.lab.verify.effect_checks import late_effects
from servod.lab.verify.margins import Judgement, Sweep, arrival_of
from servod.lab.verify.pushes import PushedOff, swing_limit_rad
from servod.lab.verify.rest_checks import RESTING_POLE, resting_radius, resting_speed
from servod.lab.verify.sampled import timing_of
from servod.lab.verify.steady_friction import SteadyFriction
from servod.lab.verify.trials import ERROR_SHARE, monte_carlo, scale_of

#: Bandwidths, best first: the first is taken with which every corner of the intervals stands with CORNER_WANTED, and
#: the axis as modelled with the wanted disk margin, or else with the one of the certificate.
OBSERVERS_RAD_S = (80.0, 60.0, 45.0, 34.0, 25.0, 18.0, 12.0, 7.0)
ENOUGH_RAD_S = 20.0  # from this bandwidth on no other choice of filter, poles and weights is tried
DISK_WANTED, CORNER_WANTED = 0.15, 1.25 * CORNER_DISK
FEW_SPEEDS = 12  # per direction
STABLE = 0.9999  # largest pole: the certificate looks between the corners and between these speeds as well
#: Bandwidth in Omega_L over that in Omega_H, best first: on its bristle a joint rests the sooner the more it is ...
LOW_FACTORS = (10.0, 8.0, 6.0, 4.5, 3.0)
#: ... up to this rate, bandwidth*k_x/c0, with which the error on the bristle goes: rest within a quarter of a second.
REST_RATE_PER_S = 20.0
#: ... and as far as one step of the encoder, which it takes for an acceleration, moves the torque by this share of the
#: largest friction: with coarse encoders a fast observer makes slow ramps stick and slip.
COUNT_SHARE = 0.05
WORTH = 1.2  # a bandwidth less than this times the least one is not worth a judgement


@dataclass
class Search:
    """Laws of one design that are tried one after the other, each first at the speeds where others failed."""

    design: Design
    friction: SteadyFriction
    refused_at: list[float] = field(default_factory=list)

    def stands(self, law: LocalParameters, disk_wanted: float, below_rad_s: float = math.inf) -> bool:
        """Whether `law` is stable at every corner with CORNER_WANTED, and has `disk_wanted` as modelled.

        And stable at the ends of what the model's own effects make of the joint; at speeds below `below_rad_s`, where
        that is all that has changed. Corners with the shorter delay count too: with two cycles they can be the worst.
        """
        cases: Sequence[LoopDeviation] = corners(self.design.uncertainty)
        counts = FEW_SPEEDS, CORNER_SPEEDS
        few, many = ([v for v in speeds_of(self.design, count) if v < below_rad_s] for count in counts)
        hard = sorted(v for v in self.refused_at if v < below_rad_s)
        if hard and self._judged(law, hard, cases, disk_wanted) is None:
            return False
        found = self._judged(law, few, cases, disk_wanted)
        if found is None or self._judged(law, many, found.hardest, disk_wanted) is None:
            return False
        own = late_effects(self.design)
        return not own or self._sweep(law, many).worst(own).radius < STABLE

    def stands_everywhere(self, law: LocalParameters, disk_wanted: float) -> bool:
        """Whether `law` stands at all corners and all the speeds of the certificate, also where others did not fail."""
        many = speeds_of(self.design, CORNER_SPEEDS)
        return self._judged(law, many, corners(self.design.uncertainty), disk_wanted) is not None

    def _sweep(self, law: LocalParameters, speeds: list[float]) -> Sweep:
        return Sweep(LAWS["local"], law.pack(), self.friction, timing_of(self.design), speeds, arrival_of(law))

    def _judged(
        self, law: LocalParameters, speeds: list[float], cases: Sequence[LoopDeviation], disk_wanted: float
    ) -> Judgement | None:
        """How `cases` stand under `law` at `speeds`; None where they do not, and the speed is kept."""
        sweep = self._sweep(law, speeds)
        margin, at = sweep.disk_margin()
        found = None if margin < disk_wanted else sweep.judge(cases)
        if found is not None and found.disk_margin >= CORNER_WANTED:
            if found.radius < STABLE:
                return found
            at = found.radius_at_rad_s
        elif found is not None:
            at = found.disk_at_rad_s
        self._refuse(abs(at))
        return None

    def _refuse(self, speed_rad_s: float) -> None:
        if speed_rad_s > 0.0 and speed_rad_s not in self.refused_at:
            self.refused_at.append(speed_rad_s)


def with_observer(
    law: LocalParameters, high_rad_s: float, low_rad_s: float | None, moving_rad_s: float | None = None
) -> LocalParameters:
    """`law` with other bandwidths of the observer that it has: in Omega_H, and in Omega_L at rest and moving.

    None: the same as in Omega_H, which is written down where it is not the one at rest.
    """
    assert law.disturbance_observer is not None
    bandwidths = {
        "bandwidth_rad_s": high_rad_s,
        "low_bandwidth_rad_s": low_rad_s,
        "low_moving_bandwidth_rad_s": moving_rad_s or (high_rad_s if low_rad_s else None),
    }
    return law.model_copy(update={"disturbance_observer": law.disturbance_observer.model_copy(update=bandwidths)})


def with_widest_observer(
    design: Design, friction: SteadyFriction, law: LocalParameters, above_rad_s: float = 0.0
) -> LocalParameters:
    """`law` with the widest observer beyond `above_rad_s` that it stands; without one where it stands none.

    A slow one gives way to one that is enough but has no bandwidth of its own for coming to rest: where the feedback
    of the regions differs much, the blend of both adds to it what no faster observer stands.
    """
    search = Search(design, friction)
    found = widest(search, law, above_rad_s, LOW_FACTORS[-1])
    if bandwidth_of(found) >= ENOUGH_RAD_S:
        return found
    even = widest(search, law, max(above_rad_s, ENOUGH_RAD_S), None)
    return even if bandwidth_of(even) else found


def widest(search: Search, law: LocalParameters, above_rad_s: float, low_factor: float | None) -> LocalParameters:
    """The same with one relation of the bandwidths; `low_factor`: in Omega_L over that in Omega_H, None: no own."""
    for disk in (DISK_WANTED, DISK_LIMIT):
        for bandwidth in (g for g in OBSERVERS_RAD_S if g > above_rad_s):
            slow = with_observer(law, bandwidth, low_factor and low_factor * bandwidth)
            if search.stands(slow, disk):
                fast = with_fastest_rest(search, slow, disk) if low_factor else slow
                if search.stands_everywhere(fast, disk):
                    return fast
    return law.model_copy(update={"disturbance_observer": None})


def bandwidth_of(law: LocalParameters) -> float:
    """Bandwidth of the observer in Omega_H [rad/s]; 0 without one."""
    return law.disturbance_observer.bandwidth_rad_s if law.disturbance_observer else 0.0


def with_fastest_rest(search: Search, law: LocalParameters, disk_wanted: float) -> LocalParameters:
    """`law`, which stands, with the widest bandwidth in Omega_L that also stands."""
    assert law.disturbance_observer is not None
    high = law.disturbance_observer.bandwidth_rad_s
    for low in low_bandwidths(search.design, search.friction, law):
        faster = with_observer(law, high, low)
        if search.stands(faster, disk_wanted, law.regions.overlap_to_rad_s):
            return faster
    return law


def low_bandwidths(design: Design, friction: SteadyFriction, law: LocalParameters) -> Iterable[float]:
    """Bandwidths in Omega_L that are worth a try beyond the least one, best first [rad/s]."""
    assert law.disturbance_observer is not None
    high = law.disturbance_observer.bandwidth_rad_s
    enough = REST_RATE_PER_S * friction.stiffness / (law.input_scale_nm * law.regions.low.k_x_per_rad)
    if design.counts_per_turn:
        step_nm_s = friction.inertia * 2.0 * math.pi / design.counts_per_turn / design.period_s
        enough = min(enough, COUNT_SHARE * friction.largest(design.speed_max_rad_s) / step_nm_s)
    wanted = sorted({min(factor * high, enough) for factor in LOW_FACTORS[:-1]}, reverse=True)
    return [low for low in wanted if low > WORTH * LOW_FACTORS[-1] * high]


# --- Compensating gains ----------------------------------------------------------------------------------------------
# The local compensating gains l_i of (9), designed: the largest that the sampled loop stands with a stated margin. l_i
# is integral action through the friction state, and the only one of a law without output observer. Its sign makes z_hat
# push the way the feedback pushes; with the other one the loop is unstable at every size (positive feedback around an
# integrator), so only l > 0 is looked for. How much a set may have depends on its speed: creeping, where z_hat hardly
# leaks, 0.03 is the limit on the paper's joint, ten times that where friction settles fast. One common gain would be
# that of the slowest set, and tracks a quarter worse.


#: Candidates [rad/s per unit of u* = u/K].
GAINS = (0.005, 0.007, 0.01, 0.014, 0.02, 0.028, 0.04, 0.056, 0.08, 0.11, 0.16, 0.23)
SPEEDS = 12  # per direction at which the largest gain is looked for; between them the smaller neighbour holds
MARGIN = 1.5 * DISK_LIMIT  # disk margin that is left
SHRINK, SHRINKS = 0.85, 12  # of all gains together, until the whole set stands


def with_gains(law: LocalParameters, speeds: list[float], gains: list[float]) -> LocalParameters:
    """`law` with l_i by the speed of each set, linear between `speeds` [rad/s] and held beyond them."""
    sets = [
        s.model_copy(update={"gain": float(np.interp(abs(s.velocity_rad_s), speeds, gains))}) for s in law.friction.sets
    ]
    return law.model_copy(update={"friction": law.friction.model_copy(update={"sets": sets})})


def stands(design: Design, friction: SteadyFriction, law: LocalParameters, speeds: list[float]) -> bool:
    """Whether the sampled loop is stable at every corner of the intervals with the margin, at rest and at `speeds`."""
    sweep = Sweep(LAWS["local"], law.pack(), friction, timing_of(design), speeds)
    late = late_corners(design.uncertainty)
    wide = sweep.disk_margin()[0] >= MARGIN and sweep.disk_margin(late)[0] >= CORNER_DISK
    return wide and sweep.worst(late).radius < 1.0


def largest_gain(design: Design, friction: SteadyFriction, law: LocalParameters, speed: float) -> float:
    """Largest common l of the candidates that the loop stands at `speed`; 0 when it stands none."""

    def too_much(index: int) -> bool:
        return not stands(design, friction, with_gains(law, [speed], [GAINS[index]]), [speed])

    index = bisect.bisect_left(range(len(GAINS)), True, key=too_much)
    return GAINS[index - 1] if index else 0.0


def designed(design: Design, friction: SteadyFriction, law: LocalParameters) -> LocalParameters:
    """`law` with its l_i designed: per speed the largest that stands, and all together still with the margin."""
    speeds = speeds_of(design, SPEEDS)
    largest = [largest_gain(design, friction, law, speed) for speed in speeds]
    held = [min(largest[max(i - 1, 0) : i + 2]) for i in range(SPEEDS)]
    dense = speeds_of(design, 2 * SPEEDS)
    for step in range(SHRINKS):
        candidate = with_gains(law, speeds, [SHRINK**step * gain for gain in held])
        if stands(design, friction, candidate, dense):
            return candidate
    return with_gains(law, speeds, [0.0] * SPEEDS)


# --- The observer while the reference moves --------------------------------------------------------------------------
# How fast the output observer may be in Omega_L while the reference moves, tried on simulated plants. A fast observer
# tracks best, yet where friction turns over it has taken the old direction for a disturbance, and may throw the joint
# forward: no pole shows that, a slow sine does. And it may keep a joint that something pushed in another motion.


PLANTS, SEED = 20, 11  # of the trial; the certificate draws others, and many more
#: Largest figure of these plants as a share of what the certificate allows: it meets worse ones.
TRIED_SHARE = 0.5
#: Bandwidths that are tried, best first, as shares of the way from the one of coming to rest to that of Omega_H. Faster
#: ones gain little where it is slow and lose more where it is not: of the demo's joint errors on the slow validation
#: sine and on sines of 0.5 to 20 Hz, RMS, are 46 and 121 urad with none of the way, 56 and 63 with half, 67 and 47
#: with all of it.
MOVING_SHARES = (0.5, 0.75)


def with_moving_observer(gains: GainSet, friction: SteadyFriction) -> GainSet:
    """`gains` with a bandwidth of its own in motion, the first that stands, follows and returns; sealed.

    Where none does it has the one of Omega_H, and the velocity that returns with that.
    """
    law, design = gains.parameters, gains.design
    assert isinstance(law, LocalParameters) and law.disturbance_observer is not None and design is not None
    high, rest = law.disturbance_observer.bandwidth_rad_s, law.disturbance_observer.low_bandwidth_rad_s
    search = Search(design, friction)
    for moving in [rest * (high / rest) ** share for share in MOVING_SHARES] if rest else []:
        faster = with_observer(law, high, rest, moving)
        found = gains.model_copy(update={"parameters": faster}).sealed()
        stands = search.stands(faster, DISK_LIMIT, law.regions.overlap_to_rad_s)
        if stands and follows(found) and returns(found, design):
            return found
    return with_returning_velocity(gains)


def follows(gains: GainSet) -> bool:
    """Whether every plant of the trial follows the slow sine with something to spare."""
    tried = monte_carlo(gains, PLANTS, SEED, processes=1)
    return max(trial.error_share for trial in tried) < TRIED_SHARE * ERROR_SHARE


def returns(gains: GainSet, design: Design) -> bool:
    """Whether the joint as modelled comes back to every sine that it was pushed off, with something to spare."""
    pushed = PushedOff(gains, design.model, design, scale_of(design))
    return all(excess < TRIED_SHARE * swing_limit_rad(design) for excess in pushed.excesses_rad())


def with_returning_velocity(gains: GainSet) -> GainSet:
    """`gains`, or the same with the reference's velocity as it is where that alone comes back from pushes; sealed.

    Without an output observer, weak feedback and friction that falls much leave the correction a swing of its own.
    """
    law, design = gains.parameters, gains.design
    assert isinstance(law, LocalParameters) and design is not None
    if law.friction.velocity is not VelocitySource.CORRECTED_REFERENCE or returns(gains, design):
        return gains
    friction = law.friction.model_copy(update={"velocity": VelocitySource.REFERENCE})
    note = f"{gains.provenance.note} Friction follows the plain reference: corrected it swings by itself."
    origin = gains.provenance.model_copy(update={"note": note})
    changed = {"parameters": law.model_copy(update={"friction": friction}), "provenance": origin}
    plain = gains.model_copy(update=changed).sealed()
    return plain if returns(plain, design) else gains


# --- Feedback and observer at rest -----------------------------------------------------------------------------------
# How much of feedback and observer is left of a joint at rest: as little as its loops at rest stand. At rest a joint
# stands on its bristle, and what feedback adds is the encoder's noise: less of it keeps the joint where it is, yet
# where friction falls steeply with speed too little lets it hunt.


#: Best first: at 20 bit the first holds a joint within 5 urad, all of the feedback within 15 to 45.
SHARES = (0.3, 0.45, 0.6, 0.8, 1.0)


def with_share_at_rest(gains: GainSet) -> GainSet:
    """`gains` with the least share at rest with which every corner stands, or else with all of it; sealed."""
    for share in SHARES:
        found = gains.model_copy(
            update={"parameters": gains.parameters.model_copy(update={"rest_share": share})}
        ).sealed()
        if stands_at_rest(found):
            break
    return found


def stands_at_rest(gains: GainSet) -> bool:
    """Whether the loops at rest are inside by what verification asks of them."""
    law, design = gains.parameters, gains.design
    assert isinstance(law, LocalParameters) and design is not None
    if not law.rest_within_rad:
        return True
    subject = Subject(gains, design, plants=0, seed=0, processes=1)
    return resting_radius(subject, law, resting_speed(law.rest_within_rad)) <= RESTING_POLE
