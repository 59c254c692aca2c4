"""What an identification found, as the axis model file and as one document with every number and interval.

Behind the analysis; what stands here is what synthesis, certificate and report read.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel, LocalFriction
from servod.formats.model.effects import ActuatorLag, Cogging, Gravity, JointElasticity
from servod.formats.model.identified import Devices, Identified, IdentifiedMap, IdentifiedValue
from servod.formats.model.keys import Harmonic as ModelHarmonic
from servod.lab.identify.analysis import Analysis, assumed_damping
from servod.lab.identify.estimate import Estimate
from servod.lab.identify.fits.cogging import GRAVITY
from servod.lab.identify.fits.curve import CurveFit
from servod.lab.identify.fits.friction_map import Side
from servod.lab.identify.fits.response import Resonance, ResponseFit

Array = NDArray[np.float64]

#: The viscous part of the map leaves at least this share of it to the bristles, at every speed.
LEAST_DRY_SHARE = 0.2
#: Half width of a 95 % interval over the standard deviation, two-sided.
TWO_SIDED = 1.96

#: What these experiments cannot tell, and what would.
NOT_IDENTIFIABLE: dict[str, str] = {
    "torque_gain": "torque is known only by the command; hang a known weight on a known lever, or couple a known "
    "inertia, and identify again: the ratio is the gain",
    "torque_offset": "a constant torque looks like friction that differs by direction, and is contained in the map; "
    "turn the axis over (or take the load off) and identify again",
    "resonance_hz": "the joint is rigid as far as the multisine reaches, 160 Hz; for one beyond, identify again "
    "with a shorter cycle.period_us, or knock on the load while servoctl record runs",
    "sigma1": "the ringing of the joint on its bristles is lost in the encoder's steps; identify again with an encoder "
    "of 20 bit or more. The model assumes half of the critical damping",
}


def model_of(analysis: Analysis) -> AxisModel:
    """The axis model: bristle, map per direction, cogging, delay; and `identified` with the intervals."""
    answer, stiffness = analysis.response, analysis.presliding.stiffness.value
    lag_s = answer.lag_s.value
    return AxisModel(
        inertia=answer.inertia.value,
        delay_s=round(answer.delay_s.value, 9),
        friction=LocalFriction(
            kind="local",
            sigma0=stiffness,
            sigma1=_damping(analysis),
            viscous=_viscous(analysis),
            velocities=_rounded(_velocities(analysis)),
            torques=_rounded(_torques(analysis)),
        ),
        gravity=_gravity(analysis),
        cogging=_cogging(analysis),
        actuator_lag=ActuatorLag(time_constant_s=lag_s) if lag_s > 0.0 else None,
        joint_elasticity=_elasticity(answer.resonance),
        identified=identified(analysis),
    )


def identified(analysis: Analysis) -> Identified:
    """Every number with its interval, and what cannot be told."""
    return Identified(
        values={name: _value(number) for name, number in estimates(analysis).items()},
        friction_map=IdentifiedMap(
            velocities=list(_rounded(_velocities(analysis))),
            torques=list(_rounded(_torques(analysis))),
            half_widths=list(_rounded(_both(analysis.map.negative.half_width, analysis.map.positive.half_width))),
        ),
        not_identifiable=_not_identifiable(analysis),
        devices=None if analysis.devices == Devices() else analysis.devices,
        data_sha256=list(analysis.data_sha256),
    )


def estimates(analysis: Analysis) -> dict[str, Estimate]:
    """All estimates by name, SI units."""
    answer = analysis.response
    numbers = {
        "inertia": answer.inertia,
        "delay_s": answer.delay_s,
        "lag_s": answer.lag_s,
        "viscous_slope": answer.viscous_slope,
        "sigma0": analysis.presliding.stiffness,
        "break_away_positive": analysis.break_away.positive,
        "break_away_negative": analysis.break_away.negative,
        **_of_curve(analysis.positive, "positive"),
        **_of_curve(analysis.negative, "negative"),
        "encoder_noise_rms": analysis.noise.encoder_rms,
        "torque_reading_noise_rms": analysis.noise.torque_reading_rms,
        "torque_noise_rms": analysis.torque_noise,
    }
    numbers |= {
        "gravity" if wave.order == GRAVITY else f"cogging_{wave.order}": wave.amplitude for wave in analysis.map.cogging
    }
    if analysis.damping is not None:
        numbers["sigma1"] = analysis.damping
    if answer.resonance is not None:
        numbers |= {"resonance_hz": answer.resonance.frequency_hz, "load_inertia": answer.resonance.load_inertia}
    return numbers


def document(analysis: Analysis) -> dict[str, Any]:
    """The JSON document of `servoctl identify`."""
    found = identified(analysis)
    low, high = _lean(analysis)
    return {
        "identified": {name: number.model_dump() for name, number in found.values.items()},
        "friction_map": found.friction_map.model_dump(),
        "asymmetry": {"value": 0.5 * (low + high), "low": low, "high": high, "unit": "1"},
        "frequency_response": frequency_response(analysis.response),
        "not_identifiable": dict(found.not_identifiable),
        "data_sha256": list(found.data_sha256),
    }


def frequency_response(found: ResponseFit) -> dict[str, Any]:
    """Position over torque command at the multisine's lines: measured, fitted, and how far to be trusted.

    `half_width` is that of the gain's 95 % interval as a share of it (and of the phase's in rad); `used` are the lines
    that inertia, delay, lag and resonance rest on.
    """
    fitted = found.model(found.frequency_hz)
    return {
        "frequency_hz": list(_rounded(found.frequency_hz)),
        "gain_rad_per_nm": list(_rounded(np.abs(found.response))),
        "phase_deg": list(_rounded(np.degrees(found.phase_rad(found.response)))),
        "half_width": list(_rounded(TWO_SIDED * found.deviation)),
        "coherence": list(_rounded(found.coherence)),
        "used": found.used.tolist(),
        "fitted_gain_rad_per_nm": list(_rounded(np.abs(fitted))),
        "fitted_phase_deg": list(_rounded(np.degrees(found.phase_rad(fitted)))),
    }


def _damping(analysis: Analysis) -> float:
    """sigma1: measured, or assumed where the encoder is too coarse for it."""
    if analysis.damping is not None:
        return analysis.damping.value
    return assumed_damping(analysis.response.inertia.value, analysis.presliding.stiffness.value)


def _not_identifiable(analysis: Analysis) -> dict[str, str]:
    found = {"sigma1": analysis.damping is not None, "resonance_hz": analysis.response.resonance is not None}
    return {name: remedy for name, remedy in NOT_IDENTIFIABLE.items() if not found.get(name, False)}


def _of_curve(curve: CurveFit, direction: str) -> dict[str, Estimate]:
    return {f"{name}_{direction}": number for name, number in curve._asdict().items()}


def _value(number: Estimate) -> IdentifiedValue:
    value, low, high = _rounded([number.value, number.low, number.high])
    return IdentifiedValue(value=value, low=low, high=high, unit=number.unit, note=number.note)


def _rounded(values: Iterable[float]) -> tuple[float, ...]:
    """Six digits: far below any interval, and readable."""
    return tuple(float(f"{float(value):.6g}") for value in values)


def _both(negative: Array, positive: Array) -> Array:
    """Values of both directions in the order of ascending velocity."""
    return np.concatenate([negative[::-1], positive])


def _velocities(analysis: Analysis) -> Array:
    return _both(-analysis.map.negative.speed, analysis.map.positive.speed)


def _torques(analysis: Analysis) -> Array:
    return _both(-analysis.map.negative.friction, analysis.map.positive.friction)


def _viscous(analysis: Analysis) -> float:
    """d0 of the map: the weaker direction's viscous friction, as far as the map leaves a dry part everywhere."""
    sides: list[Side] = [analysis.map.positive, analysis.map.negative]
    most = min(float(np.min((1.0 - LEAST_DRY_SHARE) * side.friction / side.speed)) for side in sides)
    return min(analysis.positive.viscous.value, analysis.negative.viscous.value, most)


def _cogging(analysis: Analysis) -> Cogging | None:
    waves = [wave for wave in analysis.map.cogging if wave.order != GRAVITY]
    if not waves:
        return None
    return Cogging(
        harmonics=tuple(
            ModelHarmonic(amplitude=w.amplitude.value, periods_per_turn=float(w.order), phase=w.phase) for w in waves
        )
    )


def _gravity(analysis: Analysis) -> Gravity | None:
    """The wave of one period a turn: a pendulum, amplitude*sin(x + phase)."""
    for wave in analysis.map.cogging:
        if wave.order == GRAVITY:
            return Gravity(amplitude=wave.amplitude.value, phase=wave.phase)
    return None


def _elasticity(resonance: Resonance | None) -> JointElasticity | None:
    """The spring in the joint, where one was found."""
    if resonance is None:
        return None
    joint = resonance.joint
    load, stiffness, damping = _rounded([joint.load_inertia, joint.stiffness, joint.damping])
    return JointElasticity(load_inertia=load, stiffness=stiffness, damping=damping)


def _lean(analysis: Analysis) -> tuple[float, float]:
    """Interval of the friction's asymmetry: difference of both directions over their mean, over the map's nodes."""
    plus, minus = analysis.map.positive, analysis.map.negative
    other = np.interp(np.log(plus.speed), np.log(minus.speed), minus.friction)
    other_half = np.interp(np.log(plus.speed), np.log(minus.speed), minus.half_width)
    mean = 0.5 * (plus.friction + other)
    lean = float(np.mean((plus.friction - other) / mean))
    half = float(np.mean(np.hypot(plus.half_width, other_half) / mean))
    return lean - half, lean + half


# --- What has changed ------------------------------------------------------------------------------------------------
# What has changed on an axis between two identifications: the repeat that a worn, cold or newly loaded joint asks for.
# Reads only what stands in two axis model files.


#: A difference counts beyond this multiple of both half widths together: among some thirty numbers, one that lies just
#: outside both intervals is no news.
BEYOND = 1.25
#: Numbers that say where the joint stood or how noisy the moment was, not what the joint is.
OF_THE_MOMENT = ("break_away_positive", "break_away_negative", "torque_noise_rms", "torque_reading_noise_rms")
SLOWEST_RAD_S = 0.005
_NODES = 40


def changes(before: Identified, now: Identified) -> list[str]:
    """One sentence for each number, and for each direction of the friction map, that changed; empty when none did."""
    sentences = [
        text
        for name, new in now.values.items()
        if name in before.values and name not in OF_THE_MOMENT
        if (text := _of_value(name, before.values[name], new))
    ]
    for direction, sign in (("positive", 1.0), ("negative", -1.0)):
        sentences += _of_map(direction, *(_side(found.friction_map, sign) for found in (before, now)))
    return sentences


def _of_value(name: str, old: IdentifiedValue, new: IdentifiedValue) -> str:
    """The sentence, empty when the difference is within both intervals."""
    allowed = BEYOND * 0.5 * (old.high - old.low + new.high - new.low)
    if abs(new.value - old.value) <= allowed:
        return ""
    return f"{name} went from {old.value:.4g} to {new.value:.4g} {new.unit}, outside both 95 % intervals"


def _of_map(direction: str, old: tuple[Array, Array, Array], new: tuple[Array, Array, Array]) -> list[str]:
    """Mean change of friction over the speeds that both maps have."""
    speed = np.geomspace(max(SLOWEST_RAD_S, old[0][0], new[0][0]), min(old[0][-1], new[0][-1]), _NODES)
    friction, half = ([np.interp(speed, side[0], side[i]) for side in (old, new)] for i in (1, 2))
    change = 100.0 * float(np.mean(friction[1] / friction[0] - 1.0))
    unsure = 100.0 * float(np.mean(np.hypot(half[0], half[1]) / friction[0]))
    if abs(change) <= BEYOND * unsure:
        return []
    verb = "rose" if change > 0.0 else "fell"
    return [
        f"friction in {direction} direction {verb} by {abs(change):.1f} % over the map (95 % interval "
        f"{abs(change) - unsure:.1f} to {abs(change) + unsure:.1f} %)"
    ]


def _side(found: IdentifiedMap, sign: float) -> tuple[Array, Array, Array]:
    """Speed, friction magnitude and half width of one direction, ascending."""
    velocity, torque, half = (np.array(column) for column in (found.velocities, found.torques, found.half_widths))
    here = velocity * sign > 0.0
    order = np.argsort(np.abs(velocity[here]))
    return np.abs(velocity[here])[order], np.abs(torque[here])[order], half[here][order]
