"""What is tuned of each law, within which bounds, and how the numbers become a law's parameters.

Stands on the axis model and the laws' parameter models. Every law gets the same data: inertia, bristle stiffness,
friction map per direction and cogging of the model. What it can make of them is its own: the disturbance observer takes
the inertia (viscous friction in it was tuned to zero everywhere), the LuGre observer one curve for both directions, the
local law the whole map and the cogging.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servod.formats.gains.parameters import (
    LocalFrictionSets,
    LocalParameters,
    OutputObserver,
    Parameters,
    PdDobParameters,
    PdLugreParameters,
    PdParameters,
    RegionGains,
    Regions,
    VelocitySource,
)
from servod.formats.model.axis_model import AxisModel
from servod.lab.synthesize.local_sets import (
    ACCURACY,
    LIMIT_SHARE,
    compensator,
    input_scale,
    local_sets,
    position_feedforward,
)
from servod.lab.synthesize.regions import OVERLAP_RAD_S
from servod.lab.tune.plan import Feedback, TuningSettings
from servod.lab.verify.steady_friction import SteadyFriction, steady_friction

# --- One friction curve ----------------------------------------------------------------------------------------------
# One friction curve for both directions, fitted to the axis model's map: what the LuGre observer (18) can hold. The
# paper's observer has one set of parameters; that a real joint's directions differ is its handicap by nature and not by
# tuning.


Array = NDArray[np.float64]

SPEEDS = 60
SLOWEST_SHARE = 1e-3  # of the largest speed; slower, friction is presliding


@dataclass(frozen=True, slots=True)
class SymmetricFriction:
    """F_C, F_S [N*m], v_s [rad/s] and F_v [N*m*s/rad] of (18)."""

    coulomb: float
    static: float
    stribeck_velocity: float
    viscous: float

    def torque(self, speed: Array) -> Array:
        """Steady friction at `speed` > 0."""
        fall = np.exp(-((speed / self.stribeck_velocity) ** 2))
        steady: Array = self.coulomb + (self.static - self.coulomb) * fall + self.viscous * speed
        return steady


def symmetric(friction: SteadyFriction, speed_max: float) -> SymmetricFriction:
    """Least squares over the mean of both directions, up to `speed_max` [rad/s].

    For each v_s the other three are linear and at least zero; v_s is searched on a grid. F_S is at least F_C.
    """
    speed: Array = np.geomspace(SLOWEST_SHARE * speed_max, speed_max, SPEEDS)
    mean = np.array([0.5 * (friction.torque(v) - friction.torque(-v)) for v in speed.tolist()])
    fits = [_fit(speed, mean, v_s) for v_s in np.geomspace(0.01 * speed_max, speed_max, 80).tolist()]
    return min(fits, key=lambda fit: fit[0])[1]


def _fit(speed: Array, torque: Array, v_s: float) -> tuple[float, SymmetricFriction]:
    """(relative residual, curve) with the given v_s; a map without a dry part counts a thousandth as dry."""
    from scipy.optimize import nnls

    parts = np.stack([np.ones_like(speed), np.exp(-((speed / v_s) ** 2)), speed], axis=1)
    (coulomb, fall, viscous), residual = nnls(parts / torque[:, None], np.ones_like(speed))
    dry = max(float(coulomb), 1e-3 * float(torque.max()))
    return float(residual), SymmetricFriction(dry, dry + float(fall), v_s, float(viscous))


#: K_P [N*m/rad] and K_D [N*m*s/rad] of Table I, for its friction of about 0.1 N*m.
PAPER_K_P, PAPER_K_D, PAPER_TORQUE_NM = 2.5, 0.12, 0.1

Values = Mapping[str, float]


@dataclass(frozen=True)
class AxisFacts:
    """The facts of one axis that the laws are built from."""

    model: AxisModel
    plan: TuningSettings

    @cached_property
    def friction(self) -> SteadyFriction:
        """Steady friction of the model."""
        return steady_friction(self.model)

    @cached_property
    def one_curve(self) -> SymmetricFriction:
        """The friction map as the LuGre observer can hold it."""
        return symmetric(self.friction, self.plan.speed_max_rad_s)

    @property
    def largest_nm(self) -> float:
        """Largest friction up to the plan's speed."""
        return self.friction.largest(self.plan.speed_max_rad_s)

    @property
    def scale_nm(self) -> float:
        """K: the power of ten next to the largest friction, 0.1 N*m for the paper's joint."""
        return input_scale(self.friction, self.plan.speed_max_rad_s)

    @property
    def size(self) -> float:
        """How many times the paper's joint this axis is, in torque; PD gains scale with it."""
        return self.scale_nm / PAPER_TORQUE_NM

    @property
    def count_rad(self) -> float:
        """The encoder's resolution; for one without steps that of 20 bit."""
        return 2.0 * math.pi / (self.plan.counts_per_turn or 2.0**20)

    def paper_pd(self) -> PdParameters:
        """The paper's PD, scaled: the equal feedback, and the measure of roughness."""
        return PdParameters.model_validate({"law": "pd", **self.feedback({})})

    def feedback(self, values: Values) -> dict[str, float]:
        """PD gains and the inertia's feed-forward, which every law has; `k_p`, `k_d` are multiples of the paper's."""
        return {
            "position_gain_nm_per_rad": PAPER_K_P * self.size * values.get("k_p", 1.0),
            "velocity_gain_nms_per_rad": PAPER_K_D * self.size * values.get("k_d", 1.0),
            "feedforward_inertia_kg_m2": self.friction.inertia,
        }


#: Digits of a number that is tuned.
DIGITS = 12


@dataclass(frozen=True, slots=True)
class Range:
    """One number that is tuned: its bounds, where the search starts, and whether it goes by ratios."""

    low: float
    high: float
    start: float
    ratios: bool = True

    def at(self, share: float) -> float:
        """The value at `share` (0 to 1) of the range, in as many digits as come back the same from their own share.

        A joint that sticks makes another motion of the last bit, and then a start would not cost what it cost before.
        """
        value = self.low * (self.high / self.low) ** share if self.ratios else self.low + (self.high - self.low) * share
        return float(f"{value:.{DIGITS}g}")

    def share(self, value: float) -> float:
        """Where in the range `value` is, 0 to 1."""
        if self.ratios:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


#: Multiples of the paper's PD gains. Beyond these ends the loop of a cycle of delay is unstable, or does not slide.
FREE_FEEDBACK = {"k_p": Range(0.3, 100.0, 3.0), "k_d": Range(0.3, 20.0, 1.5)}
#: The equal class in these multiples.
PAPER_FEEDBACK = {"k_p": 1.0, "k_d": 1.0}
_HOLD = Range(1.2, 30.0, 3.0)  # hold width in counts: how far from rest nothing integrates
_STIFFNESS = Range(0.05, 0.9, 0.75)  # c0_hat as a share of c0; from 1.0 on the loop is unstable


@dataclass(frozen=True, slots=True)
class Rival:
    """One contender: the law it runs, what is tuned of it beside the feedback, and how the values become parameters.

    `fixed` are numbers that are not tuned; `forerunners` are contenders that have some of this one's numbers fixed, and
    whose best sets its search starts from. `searches` is how many such searches share the budget of the law.
    """

    law: str
    ranges: Mapping[str, Range]
    build: Callable[[AxisFacts, Values], Parameters]
    fixed: Mapping[str, float] = field(default_factory=dict)
    forerunners: tuple[str, ...] = ()
    searches: int = 1

    def space(self, feedback: Feedback) -> dict[str, Range]:
        """All that is tuned in a class."""
        return dict(self.ranges) | (FREE_FEEDBACK if feedback is Feedback.FREE else {})


def _pd(axis: AxisFacts, values: Values) -> PdParameters:
    return PdParameters.model_validate({"law": "pd", **axis.feedback(values)})


def _pd_dob(axis: AxisFacts, values: Values) -> PdDobParameters:
    return PdDobParameters.model_validate(
        {
            "law": "pd_dob",
            **axis.feedback(values),
            "bandwidth_rad_s": values["bandwidth"],
            "inertia_kg_m2": axis.friction.inertia,
            "disturbance_limit_nm": LIMIT_SHARE * axis.largest_nm,
            "hold_within_rad": values["hold"] * axis.count_rad,
        }
    )


def _pd_lugre(axis: AxisFacts, values: Values) -> PdLugreParameters:
    curve = axis.one_curve
    return PdLugreParameters.model_validate(
        {
            "law": "pd_lugre",
            **axis.feedback(values),
            "stiffness_nm_per_rad": values["stiffness"] * axis.friction.stiffness,
            "damping_nms_per_rad": values["damping"] * axis.friction.damping(0.0),
            "viscous_nms_per_rad": curve.viscous,
            "coulomb_nm": curve.coulomb,
            "static_nm": curve.static,
            "stribeck_velocity_rad_s": curve.stribeck_velocity,
            "observer_gain": values["gain"],
            "input_scale_nm": axis.scale_nm,
            "hold_within_rad": values["hold"] * axis.count_rad,
            "friction_limit_nm": LIMIT_SHARE * axis.largest_nm,
        }
    )


def _local(axis: AxisFacts, values: Values) -> LocalParameters:
    """Velocity of the reference in the friction state, output observer, feed-forward over position; equal regions."""
    friction, speed, scale = axis.friction, axis.plan.speed_max_rad_s, axis.scale_nm
    c, pd = compensator(friction, speed, values["stiffness"]), axis.feedback(values)
    gains = RegionGains(
        k_x_per_rad=pd["position_gain_nm_per_rad"] / scale, k_v_s_per_rad=pd["velocity_gain_nms_per_rad"] / scale
    )
    return LocalParameters(
        law="local",
        input_scale_nm=scale,
        regions=Regions(low=gains, high=gains, overlap_from_rad_s=OVERLAP_RAD_S[0], overlap_to_rad_s=OVERLAP_RAD_S[1]),
        friction=LocalFrictionSets(
            stiffness_nm_per_rad=c.stiffness,
            viscous_nms_per_rad=c.viscous,
            friction_limit_nm=LIMIT_SHARE * axis.largest_nm,
            velocity=VelocitySource.REFERENCE,
            lead_s=values["lead"],
            sets=local_sets(friction, c, speed, ACCURACY, values["gain"]),
        ),
        disturbance_observer=OutputObserver(
            bandwidth_rad_s=values["bandwidth"],
            inertia_kg_m2=friction.inertia,
            disturbance_limit_nm=LIMIT_SHARE * axis.largest_nm,
        ),
        feedforward_inertia_kg_m2=friction.inertia,
        hold_within_rad=values["hold"] * axis.count_rad,
        position_feedforward=position_feedforward(axis.model, friction.gain, axis.plan.period_s),
    )


_BANDWIDTH = Range(5.0, 1000.0, 50.0)
_SHARE = Range(0.0, 1.0, 0.5, ratios=False)
_LUGRE = {"stiffness": _STIFFNESS, "damping": _SHARE, "hold": _HOLD}

_FIXED_L = {"pd_lugre_025": 0.25, "pd_lugre_035": 0.35}
_LUGRE_SEARCHES = 1 + len(_FIXED_L)

#: The contenders by name, in the order of a table; the four laws by their own names, l_f of the paper's Fig. 17 beside.
#: Tuned with all else, in six dimensions, l_f found no set as good as one of the fixed l_f, so it starts from those.
RIVALS: dict[str, Rival] = {
    "pd": Rival("pd", {}, _pd),
    "pd_dob": Rival("pd_dob", {"bandwidth": _BANDWIDTH, "hold": _HOLD}, _pd_dob),
    "pd_lugre": Rival(
        "pd_lugre",
        {"gain": Range(0.0, 1.2, 0.2, ratios=False), **_LUGRE},
        _pd_lugre,
        forerunners=tuple(_FIXED_L),
        searches=_LUGRE_SEARCHES,
    ),
    **{
        name: Rival("pd_lugre", _LUGRE, _pd_lugre, {"gain": gain}, searches=_LUGRE_SEARCHES)
        for name, gain in _FIXED_L.items()
    },
    "local": Rival(
        "local",
        {
            "gain": Range(0.0, 0.3, 0.04, ratios=False),
            "bandwidth": _BANDWIDTH,
            "stiffness": _STIFFNESS,
            "lead": Range(0.0, 0.008, 0.002, ratios=False),
            "hold": _HOLD,
        },
        _local,
    ),
}
