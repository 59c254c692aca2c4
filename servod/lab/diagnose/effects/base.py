"""The model's own parameters as unknowns: how far each may be off before it is a finding of its own.

Stands between the nominal model and every hypothesis. The bounds are those of the outside contract: up to 10 % is
recalibration; the levels from which inertia, Stribeck curve, bristle, offset and delay count as findings bound them
here, and the terms of those effects open the bounds.
"""

from __future__ import annotations

import math

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects.hypothesis import Document, Unknown, get

#: A parameter that is off by less is recalibrated, from here on it is physics.
RECALIBRATION = 0.10

#: What is known beforehand of a known parameter: off by some per cent.
KNOWN_WITHIN = 0.04

#: Where a known weight hangs: off by so much at most, and known so well, rad. More would soak up offset and asymmetry.
PHASE_OFF, PHASE_KNOWN = 0.03, 0.008

#: Levels of the contract: static - coulomb and offset as shares of Coulomb friction, bristle as a factor, delay in s.
STRIBECK_SHARE, OFFSET_SHARE, BRISTLE_FACTOR, DELAY_S = 0.25, 0.03, 2.0, 0.002

#: From which share of its own level on dry or viscous friction is a finding.
LEVEL_SHARE = 0.25

#: The Stribeck velocity is known poorly and shows little; a wide bound keeps it from being a finding.
STRIBECK_VELOCITY_FACTOR = 1.5

#: By which factor an unknown of the drive may be off what simulated runs say of it, and how well these know it.
DRIVE_FACTOR, DRIVE_KNOWN = 1.25, 0.04

#: Numbers of a drive, of which one may be unknown: what makes a torque of a command, and what makes that of an error.
DRIVE_SCALES = ("drive.torque_per_command", "drive.kp")

#: The drive's back-EMF; by which factor friction may be another beside an unknown drive, and how well it is known.
BACK_EMF, FRICTION_FACTOR, FRICTION_KNOWN = "drive.emf_viscous", 10.0, math.log(2.0)

#: Parameters that the outside contract gives a level, which is their bound until a term opens it.
LEVELS = frozenset(
    ("friction.static", "friction.stribeck_velocity", "friction.sigma0", "friction.sigma1", "torque_offset", "inertia")
)

#: Torques of the model's own, which no recording tells from a common factor on all of them and on the command.
TORQUES = (
    "inertia",
    "friction.viscous",
    "friction.coulomb",
    "friction.static",
    "friction.sigma0",
    "friction.sigma1",
    "gravity.amplitude",
)


def document_of(model: AxisModel) -> Document:
    """The model as a plain document, without what was measured and without noise."""
    plain = model.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    plain.pop("identified", None)
    plain.pop("noise", None)
    if plain.get("gravity", {}).get("amplitude", 0.0) == 0.0:
        plain.pop("gravity", None)
    return dict(plain)


def known(key: str, unit: str, value: float, off: float = RECALIBRATION, spread: float = KNOWN_WITHIN) -> Unknown:
    """A parameter known to some per cent, as a logarithm."""
    return Unknown(key, unit, value, value / (1.0 + off), value * (1.0 + off), spread=spread)


def base_unknowns(model: AxisModel, unknown: frozenset[str] = frozenset()) -> tuple[Unknown, ...]:
    """The unknowns of the model's own parameters; those keys that are `unknown` start at their values and are free."""
    document = document_of(model)
    axis = "m" if model.axis.value == "linear" else "rad"
    force = "N" if axis == "m" else "N·m"
    inertia = known("inertia", "kg" if axis == "m" else "kg·m²", model.inertia)
    own = [*_friction(document, axis, force), *_gravity(document, force), *_command(model, force)]
    own = [_beside_drive(one, document, unknown) for one in own]
    return (inertia, *own, *_drift(document, force), *_drive(document, force, unknown))


def _drive(document: Document, force: str, unknown: frozenset[str]) -> list[Unknown]:
    """What is unknown of the drive: free, with no belief beforehand."""
    units = {"drive.torque_per_command": force, "drive.kp": "1/rad"}
    found = [
        known(key, units[key], get(document, key), DRIVE_FACTOR - 1.0, DRIVE_KNOWN)
        for key in sorted(unknown & units.keys())
    ]
    if BACK_EMF in unknown:
        size = _viscous_size(document)
        found.append(Unknown(BACK_EMF, f"{force}·s/rad", 0.0, 0.0, FRICTION_FACTOR * size, size))
    return found


def _viscous_size(document: Document) -> float:
    """What back-EMF and viscous friction are told in: the model's own, or its dry friction at a radian a second."""
    return max(get(document, "friction.viscous"), 1e-3 * get(document, "friction.coulomb"), 1e-12)


def _beside_drive(own: Unknown, document: Document, unknown: frozenset[str]) -> Unknown:
    """A number of the model's own friction beside an unknown drive.

    Friction in N*m came with a torque of the drive that somebody assumed; and what was taken for viscous friction may
    be back-EMF, all of it.
    """
    if own.key == "friction.viscous" and BACK_EMF in unknown:
        size = _viscous_size(document)
        return Unknown(own.key, own.unit, own.start, 0.0, FRICTION_FACTOR * size, size)
    if unknown and own.key in {"friction.viscous", "friction.coulomb"}:
        low, high = own.start / FRICTION_FACTOR, own.start * FRICTION_FACTOR
        return Unknown(own.key, own.unit, own.start, low, high, spread=FRICTION_KNOWN)
    return own


def _friction(document: Document, axis: str, force: str) -> list[Unknown]:
    """The friction law's parameters; a local map keeps its curve, and what of it is viscous.

    Beside given torques that only moves friction from the bristle to the viscous part, which recordings hardly show;
    and the levels of both parts would be factors on others than the model's.
    """
    found = []
    coulomb = get(document, "friction.coulomb")
    measured = document["friction"]["kind"] == "local"
    for key, unit in (("viscous", f"{force}·s/{axis}"), ("coulomb", force)):
        value = get(document, f"friction.{key}")
        if value > 0.0 and not measured:
            found.append(known(f"friction.{key}", unit, value))
    static = get(document, "friction.static")
    if static > 0.0 and coulomb > 0.0:
        room = 1.0 + STRIBECK_SHARE * coulomb / static
        found.append(known("friction.static", force, static, room - 1.0))
        speed = get(document, "friction.stribeck_velocity", 0.1)
        factor = STRIBECK_VELOCITY_FACTOR - 1.0
        found.append(known("friction.stribeck_velocity", f"{axis}/s", speed, factor, math.log(1.2)))
    for key, unit in (("sigma0", f"{force}/{axis}"), ("sigma1", f"{force}·s/{axis}")):
        value = get(document, f"friction.{key}")
        if value > 0.0:
            found.append(known(f"friction.{key}", unit, value, BRISTLE_FACTOR - 1.0, math.log(1.2)))
    return found


def _gravity(document: Document, force: str) -> list[Unknown]:
    amplitude = get(document, "gravity.amplitude")
    if amplitude == 0.0:
        return []
    phase = get(document, "gravity.phase")
    turn = Unknown("gravity.phase", "rad", phase, phase - PHASE_OFF, phase + PHASE_OFF, 1.0, PHASE_KNOWN)
    return [known("gravity.amplitude", force, amplitude), turn]


def _command(model: AxisModel, force: str) -> list[Unknown]:
    """Offset and delay, each within the level from which it is a finding."""
    coulomb = get(document_of(model), "friction.coulomb")
    room = OFFSET_SHARE * coulomb if coulomb > 0.0 else 1e-9
    own, late = model.torque_offset, model.delay_s
    offset = Unknown("torque_offset", force, own, own - room, own + room, max(coulomb, 1e-9), OFFSET_SHARE)
    room_s = 0.5 * DELAY_S  # what is more is for the term to say
    delay = Unknown("delay_s", "s", late, max(late - room_s, 0.0), late + room_s, 1e-3, 0.3)
    return [offset, delay]


def _drift(document: Document, force: str) -> list[Unknown]:
    """A drift that the model has from other recordings: anything from none at all to all of it in these."""
    per_s = get(document, "offset_drift.per_s")
    if per_s == 0.0:
        return []
    return [Unknown("offset_drift.per_s", f"{force}/s", per_s, min(per_s, 0.0), max(per_s, 0.0), abs(per_s), 1.0)]


def off_by_share(nominal: Document, fitted: Document, key: str) -> float:
    """By which share of what the model says a parameter is off; inf where the model says nothing of it and one is."""
    was, now = get(nominal, key), get(fitted, key)
    if was <= 0.0:
        return math.inf if now > 0.0 else 0.0
    return abs(now - was) / was


def dry_nm(document: Document) -> float:
    """The level of the model's dry friction, N*m: Coulomb friction, or the mean over a map's nodes."""
    law = document["friction"]
    if law["kind"] != "local":
        return get(document, "friction.coulomb")
    viscous = law.get("viscous", 0.0)
    parts = [abs(t - viscous * v) for v, t in zip(law["velocities"], law["torques"], strict=True)]
    return math.fsum(parts) / len(parts)


def factor(nominal: Document, fitted: Document, key: str) -> float:
    """By which factor, never below 1, a parameter is off; 1 where one of the two has none."""
    was, now = get(nominal, key), get(fitted, key)
    return max(was, now) / min(was, now) if min(was, now) > 0.0 else 1.0
