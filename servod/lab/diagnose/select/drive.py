"""What is unknown of a drive: fitted beside a plain model, before anything is looked for.

Stands between the model as it came and intake. Torque for one unit of the command, or the servo's gain: first by least
squares of the torque that the model's motion needs, at the delay that makes the most of it; then by the error of
simulated runs, a servo's loop closed, beside mass, friction, friction of the load, weight and delay. Closed loops
leave no choice between a strong drive on a stiff axis and a weak one on an easy axis, which needed torques do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.trace import dry_friction
from servod.lab.diagnose.effects.base import document_of
from servod.lab.diagnose.effects.hypothesis import get, put
from servod.lab.recordings import Recording
from servod.lab.simulate.replay import Drive, replay, switched_on
from servod.lab.simulate.servo import drive_torque

Array = NDArray[np.float64]

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


#: Recordings used, at most; steps of the fit; a run of a drive without a loop of its own is so long, s.
MOST_RECORDINGS, STEPS, HORIZON_S = 6, 12, 0.5

#: What is known beforehand, as logarithms: of mass and weight, and of friction, in which a back-EMF may be or not.
MASS_KNOWN, WEIGHT_KNOWN, FRICTION_KNOWN = 0.3, 0.04, 2.0

#: What a delay and a friction of the load may be, and at which they start.
DELAY_START_S, DELAY_SIZE_S, LOAD_START, LOAD_SIZE = 0.015, 0.02, 0.1, 0.2

#: Rows whose errors count as one, s: errors of simulated runs are slow.
CORRELATED_S = 0.25


def complete_drive(model: AxisModel, recordings: Sequence[Recording]) -> CompletedDrive:
    """The model with start values for what its drive does not say. Raises BadInput where too much is unknown."""
    law = model.drive
    if law is None:
        return CompletedDrive(model, frozenset())
    gain_known = not law.kind.feeds_back or law.kp is not None or _recorded_gain(recordings)
    if gain_known and law.factor is not None:
        return CompletedDrive(model, frozenset())
    if not gain_known and law.factor is None:
        raise BadInput("model: drive", "neither kp nor torque_per_command", "one of them: only their product shows")
    key = "torque_per_command" if gain_known else "kp"
    trial = law.model_copy(update={key: 1.0 if gain_known else SMALL})
    changed = model.model_copy(update={"drive": trial})
    value = _slope(changed, [recording.driven_by(changed) for recording in recordings])
    if value <= 0.0:
        raise BadInput(
            "recordings: goal and motion", "a torque against the goal", "the goal and the position in one sign"
        )
    value = value if gain_known else value * SMALL
    whole = model.model_copy(update={"drive": law.model_copy(update={key: value})})
    factor, error = _refined(whole, key, [recording.driven_by(whole) for recording in recordings[:MOST_RECORDINGS]])
    whole = whole.model_copy(update={"drive": law.model_copy(update={key: value * factor})})
    return CompletedDrive(whole, frozenset((f"drive.{key}",)), error)


def _refined(model: AxisModel, key: str, drives: Sequence[Drive]) -> tuple[float, float]:
    """By which factor the value that is unknown is another, by the error of simulated runs; and its relative error."""
    from scipy.optimize import least_squares

    drives = [switched_on(model, drive) for drive in drives]
    horizon_s = None if model.drive is not None and model.drive.kind.feeds_back else HORIZON_S
    counted = [drive.told.on if drive.told is not None else np.ones(len(drive.t_s), dtype=bool) for drive in drives]
    priors = np.array([0.0, 1.0 / MASS_KNOWN, 1.0 / FRICTION_KNOWN, 1.0 / FRICTION_KNOWN, 1.0 / WEIGHT_KNOWN, 0.5, 0.5])
    begun = np.array([0.0, 0.0, 0.0, 0.0, 0.0, DELAY_START_S / DELAY_SIZE_S, LOAD_START / LOAD_SIZE])

    def errors(numbers: Array) -> Array:
        trial = _plain(model, key, numbers)
        runs = (replay(trial, drive, horizon_s).error[on] for drive, on in zip(drives, counted, strict=True))
        return np.concatenate(list(runs))

    first = errors(begun)
    scale = max(float(np.median(np.abs(first))), 1e-9)
    for _ in range(2):

        def residuals(numbers: Array, scale: float = scale) -> Array:
            return np.concatenate([errors(numbers) / scale, priors * numbers])

        low, high = np.full(7, -np.log(10.0)), np.full(7, np.log(10.0))
        low[5:], high[5:] = 0.0, (5.0, 4.0)
        found = least_squares(residuals, begun, bounds=(low, high), loss="soft_l1", diff_step=1e-3, max_nfev=STEPS)
        begun = np.clip(found.x, low + 1e-6, high - 1e-6)
        scale = max(float(np.sqrt(np.mean(errors(begun) ** 2))), 1e-9)
    alike = max(1.0, CORRELATED_S / drives[0].period_s)
    size = float(np.sqrt(np.mean(found.fun[: -len(priors)] ** 2)))
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * alike * size**2
    return float(np.exp(begun[0])), float(np.sqrt(max(covariance[0, 0], 0.0)))


def _plain(model: AxisModel, key: str, numbers: Array) -> AxisModel:
    """The model with its own numbers by these factors (logarithms), a delay and friction of the load beside."""
    value, mass, viscous, dry, weight = (float(np.exp(number)) for number in numbers[:5])
    document = document_of(model)
    put(document, f"drive.{key}", get(document, f"drive.{key}") * value)
    for name, factor in (("viscous", viscous), ("coulomb", dry), ("static", dry)):
        if get(document, f"friction.{name}") > 0.0:
            put(document, f"friction.{name}", get(document, f"friction.{name}") * factor)
    if model.gravity is not None:
        put(document, "gravity.amplitude", get(document, "gravity.amplitude") * weight)
    delay_s, per_load = min(model.delay_s + DELAY_SIZE_S * float(numbers[5]), 0.25), LOAD_SIZE * float(numbers[6])
    rest = {"inertia": model.inertia * mass, "delay_s": delay_s, "load_dependent_friction.per_load": per_load}
    for name, number in rest.items():
        put(document, name, number)
    return AxisModel.model_validate(document)


def _recorded_gain(recordings: Sequence[Recording]) -> bool:
    from servod.lab.recordings import Quantity

    gains = [recording.get(Quantity.GAIN) for recording in recordings]
    return all(gain is not None and bool(np.isfinite(gain).all()) for gain in gains)


def _slope(model: AxisModel, drives: Sequence[Drive]) -> float:
    """Needed torque over the torque that the trial drive makes, at the delay at which the two go together best."""
    law = model.drive
    if law is None:
        return 0.0
    found = []
    needed = np.concatenate([_needed(model, drive) for drive in drives])
    for delay_s in DELAYS_S:
        made = np.concatenate(
            [drive_torque(law, d.told, d.t_s, d.position, delay_s) for d in drives if d.told is not None]
        )
        power = float(made @ made)
        slope = float(made @ needed) / power if power > 0.0 else 0.0
        found.append((float(np.sum((needed - slope * made) ** 2)), slope))
    return min(found)[1]


def _needed(model: AxisModel, drive: Drive) -> Array:
    """Torque that the recorded motion needs by the model, N*m."""
    position, velocity, acceleration = drive.motion[:, 0], drive.motion[:, 1], drive.motion[:, 2]
    slow = max(0.05 * float(np.std(velocity)), 1e-12)
    viscous = model.friction.viscous + (model.drive.back_emf if model.drive else 0.0)
    needed = model.inertia * acceleration + viscous * velocity + dry_friction(model) * np.tanh(velocity / slow)
    if model.gravity is not None:
        needed = needed + model.gravity.amplitude * np.sin(position + model.gravity.phase)
    return np.asarray(needed)
