"""What is unknown of a drive: fitted beside a plain model, before anything is looked for.

Stands between the model as it came and intake. Torque for one unit of the command, or the servo's gain: first by least
squares of the torque that the model's motion needs, at the delay that makes the most of it; then by the error of
simulated runs, a servo's loop closed, beside what may stand in the way: mass, friction, friction of the load, weight,
delay, the rate of the goal, back-EMF. Closed loops leave no choice between a strong drive on a stiff axis and a weak
one on an easy axis, which needed torques do. Back-EMF is told from viscous friction where the drive goes off: it is
fitted where a recording says so and the model says nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.drive import DriveLaw
from servod.lab.diagnose.data.trace import dry_friction
from servod.lab.diagnose.effects.base import document_of
from servod.lab.diagnose.effects.effect import scale_friction
from servod.lab.diagnose.effects.hypothesis import get, put
from servod.lab.recordings import Recording
from servod.lab.simulate.replay import Drive, replay, switched_on
from servod.lab.simulate.servo import drive_torque

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

#: Delays tried, s.
DELAYS_S = tuple(0.005 * step for step in range(17))

#: A gain so small that no duty comes to its limit, 1/rad.
SMALL = 1e-6


@dataclass(frozen=True)
class CompletedDrive:
    """A model whose drive lacks nothing, and the keys of it that were unknown: start values stand there."""

    model: AxisModel
    unknown: frozenset[str]
    error: float = 0.0


#: Recordings used, at most; runs are so long, s: a drive without a loop of its own runs away.
MOST_RECORDINGS, SERVO_HORIZON_S, HORIZON_S = 6, 1.0, 0.5

#: Steps of the fit, at most, and the relative gain of a step that ends it: jumps of the goal bend its valley.
STEPS, ENOUGH = 40, 1e-4

#: Rates of the goal tried, as shares of a high speed of the motion.
RATES = (0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.4)

#: Rows so long, s, in which a drive is off and the axis moves show what is friction without back-EMF.
LEAST_OFF_S = 0.2

#: Rows whose errors count as one, s: errors of simulated runs are slow.
CORRELATED_S = 0.25


@dataclass(frozen=True)
class _Number:
    """A number of the fit: start, bounds, and precision of what is known beforehand (1/spread)."""

    start: float
    low: float
    high: float
    known: float


#: The value that is unknown and what may stand in its way. Logarithms of factors: of the value, mass, viscous and dry
#: friction (in which a back-EMF may be or not), weight, goal's rate; a delay and friction of load and torque in SIZES;
#: the share of back-EMF in what is viscous.
_NUMBERS = {
    "value": _Number(0.0, -2.3, 2.3, 0.0),
    "mass": _Number(0.0, -2.3, 2.3, 1.0 / 0.3),
    "viscous": _Number(0.0, -2.3, 2.3, 0.5),
    "dry": _Number(0.0, -2.3, 2.3, 0.5),
    "weight": _Number(0.0, -2.3, 2.3, 25.0),
    "late": _Number(0.75, 0.0, 5.0, 0.5),
    "load": _Number(0.5, 0.0, 4.0, 0.5),
    "torque": _Number(0.5, 0.0, 3.0, 0.5),
    "rate": _Number(0.0, -1.0, 3.0, 0.1),
    "emf": _Number(0.5, 0.0, 1.0, 0.1),
}

#: A delay in s, friction of the load and of the torque as shares.
SIZES = {"late": 0.02, "load": 0.2, "torque": 0.2}


def complete_drive(model: AxisModel, recordings: Sequence[Recording]) -> CompletedDrive:
    """The model with start values for what its drive does not say. Raises BadInput where too much is unknown."""
    law = model.drive
    if law is None:
        return CompletedDrive(model, frozenset())
    gain_known = not law.kind.feeds_back or law.kp is not None or _recorded_gain(recordings)
    if gain_known and law.factor is not None:
        drives = [recording.driven_by(model) for recording in recordings]
        return CompletedDrive(model, _emf_keys(law, drives))
    if not gain_known and law.factor is None:
        raise BadInput("model: drive", "neither kp nor torque_per_command", "one of them: only their product shows")
    key = "torque_per_command" if gain_known else "kp"
    trial = law.model_copy(update={key: 1.0 if gain_known else SMALL})
    changed = model.model_copy(update={"drive": trial})
    drives = [recording.driven_by(changed) for recording in recordings]
    begun, emf = _begin(changed, drives), _emf_keys(law, drives)
    if begun.slope <= 0.0:
        raise BadInput(
            "recordings: goal and motion", "a torque against the goal", "the goal and the position in one sign"
        )
    value = begun.slope if gain_known else begun.slope * SMALL
    whole = model.model_copy(update={"drive": law.model_copy(update={key: value})})
    factor, error = _refined(whole, key, drives[:MOST_RECORDINGS], begun, bool(emf))
    whole = whole.model_copy(update={"drive": law.model_copy(update={key: value * factor})})
    return CompletedDrive(whole, emf | {f"drive.{key}"}, error)


def _emf_keys(law: DriveLaw, drives: Sequence[Drive]) -> frozenset[str]:
    """The key of the back-EMF where that is unknown, and a drive is off, as recorded, while the axis moves."""
    known = not law.kind.feeds_back or law.k_t is not None or "emf_viscous" in law.model_fields_set
    shown = not known and any(_off_in_motion(drive) >= LEAST_OFF_S for drive in drives)
    return frozenset(("drive.emf_viscous",)) if shown else frozenset()


def _off_in_motion(drive: Drive) -> float:
    """For how long the drive is off, as recorded, while the axis moves, s."""
    if drive.told is None or drive.told.on.all():
        return 0.0
    moves = np.abs(drive.motion[:, 1]) > 0.1 * float(np.quantile(np.abs(drive.motion[:, 1]), 0.95))
    return drive.period_s * float(np.count_nonzero(~drive.told.on & moves))


def _refined(model: AxisModel, key: str, drives: Sequence[Drive], begun: _Begun, emf: bool) -> tuple[float, float]:
    """By which factor the value that is unknown is another, by the error of simulated runs; and its relative error."""
    from scipy.optimize import least_squares

    feeds_back = model.drive is not None and model.drive.kind.feeds_back
    recorded = [drive.told is None or not drive.told.on.all() for drive in drives]
    drives = [switched_on(model, drive) for drive in drives]
    horizon_s = SERVO_HORIZON_S if feeds_back else HORIZON_S
    rows = [_counted(drive, known) for drive, known in zip(drives, recorded, strict=True)]
    absent = {name for name, there in (("rate", begun.rate is not None), ("emf", emf)) if not there}
    names = [name for name in _NUMBERS if name not in absent]
    start, low, high, known = (np.array([getattr(_NUMBERS[name], what) for name in names]) for what in _PARTS)
    at = start.copy()
    at[names.index("late")] = begun.late_s / SIZES["late"]
    if begun.rate is not None and not begun.limited:
        at[names.index("rate")] = _NUMBERS["rate"].high
    at = np.clip(at, low + 1e-6, high - 1e-6)

    def errors(numbers: Array) -> Array:
        trial = _plain(model, key, dict(zip(names, numbers.tolist(), strict=True)), begun.rate)
        runs = (replay(trial, drive, horizon_s).error[on] for drive, on in zip(drives, rows, strict=True))
        return np.concatenate(list(runs))

    scale = max(float(np.median(np.abs(errors(at)))), 1e-9)
    for _ in range(2):

        def residuals(numbers: Array, scale: float = scale) -> Array:
            return np.concatenate([errors(numbers) / scale, known * (numbers - start)])

        found = least_squares(
            residuals, at, bounds=(low, high), loss="soft_l1", diff_step=1e-3, ftol=ENOUGH, xtol=ENOUGH, max_nfev=STEPS
        )
        at = np.clip(found.x, low + 1e-6, high - 1e-6)
        scale = max(float(np.sqrt(np.mean(errors(at) ** 2))), 1e-9)
    alike = max(1.0, CORRELATED_S / drives[0].period_s)
    size = float(np.sqrt(np.mean(found.fun[: -len(names)] ** 2)))
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * alike * size**2
    return float(np.exp(at[0])), float(np.sqrt(max(covariance[0, 0], 0.0)))


#: What a number is made of, in the order in which the fit takes it.
_PARTS = ("start", "low", "high", "known")


def _counted(drive: Drive, known: bool) -> Rows:
    """Rows whose error counts: all, but those in which the drive is off by the motion alone."""
    return np.ones(len(drive.t_s), dtype=bool) if known or drive.told is None else drive.told.on


def _fast_goal(drives: Sequence[Drive]) -> float | None:
    """A high speed of the motion where the goal is much faster: it may be followed at a limited rate."""
    speed = float(np.quantile(np.abs(np.concatenate([drive.motion[:, 1] for drive in drives])), 0.98))
    fastest = max(
        float(np.max(np.abs(np.diff(drive.told.command)) / np.maximum(np.diff(drive.t_s), 1e-9)))
        for drive in drives
        if drive.told is not None
    )
    return speed if fastest > 3.0 * speed else None


def _plain(model: AxisModel, key: str, numbers: dict[str, float], rate: float | None) -> AxisModel:
    """The model with its own values by these numbers, and what may stand in the way beside."""
    document, law = document_of(model), model.drive
    put(document, f"drive.{key}", get(document, f"drive.{key}") * np.exp(numbers["value"]))
    viscous, emf = float(np.exp(numbers["viscous"])), numbers.get("emf", 0.0)
    if "emf" in numbers:
        put(document, "drive.emf_viscous", emf * viscous * get(document, "friction.viscous"))
    scale_friction(document, float(np.exp(numbers["dry"])), (1.0 - emf) * viscous)
    if model.gravity is not None:
        put(document, "gravity.amplitude", get(document, "gravity.amplitude") * np.exp(numbers["weight"]))
    if rate is not None and law is not None and law.goal_rate is None:
        put(document, "drive.goal_rate", rate * np.exp(numbers["rate"]))
    rest = {
        "inertia": model.inertia * np.exp(numbers["mass"]),
        "delay_s": min(model.delay_s + SIZES["late"] * numbers["late"], 0.25),
        "load_dependent_friction.per_load": SIZES["load"] * numbers["load"],
        "load_dependent_friction.per_command": SIZES["torque"] * numbers["torque"],
    }
    for name, number in rest.items():
        put(document, name, number)
    return AxisModel.model_validate(document)


def _recorded_gain(recordings: Sequence[Recording]) -> bool:
    from servod.lab.recordings import Quantity

    gains = [recording.get(Quantity.GAIN) for recording in recordings]
    return all(gain is not None and bool(np.isfinite(gain).all()) for gain in gains)


@dataclass(frozen=True)
class _Begun:
    """Where the fit of simulated runs begins: needed torque over that of the trial drive, delay, and rate of the goal.

    `rate` is None where the goal is never much faster than the axis; `limited` says whether it fits better than none.
    """

    slope: float
    late_s: float
    rate: float | None
    limited: bool


def _begin(model: AxisModel, drives: Sequence[Drive]) -> _Begun:
    """The delay and the rate of the goal at which needed torque and that of the trial drive go together best."""
    if (law := model.drive) is None:
        return _Begun(0.0, 0.0, None, limited=False)
    speed = _fast_goal(drives) if law.kind.feeds_back and law.goal_rate is None else None
    rates = [None] if speed is None else [None, *(share * speed for share in RATES)]
    needed = np.concatenate([_needed(model, drive) for drive in drives])
    found = []
    for rate in rates:
        trial = law if rate is None else law.model_copy(update={"goal_rate": rate})
        for late_s in DELAYS_S:
            made = np.concatenate(
                [drive_torque(trial, d.told, d.t_s, d.position, late_s) for d in drives if d.told is not None]
            )
            power = float(made @ made)
            slope = float(made @ needed) / power if power > 0.0 else 0.0
            found.append((float(np.sum((needed - slope * made) ** 2)), slope, late_s, rate))
    _, slope, late_s, rate = min(found, key=lambda one: one[0])
    return _Begun(slope, late_s, rate if rate is not None else speed, limited=rate is not None)


def _needed(model: AxisModel, drive: Drive) -> Array:
    """Torque that the recorded motion needs by the model, N*m."""
    position, velocity, acceleration = drive.motion[:, 0], drive.motion[:, 1], drive.motion[:, 2]
    slow = max(0.05 * float(np.std(velocity)), 1e-12)
    viscous = model.friction.viscous + (model.drive.back_emf if model.drive else 0.0)
    needed = model.inertia * acceleration + viscous * velocity + dry_friction(model) * np.tanh(velocity / slow)
    if model.gravity is not None:
        needed = needed + model.gravity.amplitude * np.sin(position + model.gravity.phase)
    return np.asarray(needed)
