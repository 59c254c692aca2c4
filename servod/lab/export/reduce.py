"""What a format leaves out of an axis model: one step for each effect, so that each can be told with its own cost.

Under the formats. A step takes a model and gives one without the effect, or the same model when it has none of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, get_args

import numpy as np

from servod.formats.model.axis_model import (
    AxisKind,
    AxisModel,
    CoulombViscousFriction,
    Friction,
    LocalFriction,
    LugreFriction,
    StribeckFriction,
)
from servod.formats.model.effects import Cogging, Gravity, LimitShape
from servod.formats.model.keys import Group

#: A friction map becomes a curve at this many speeds, and the curve's own speed is sought among so many.
_SPEEDS, _CURVES = 200, 60


class LostEffect(NamedTuple):
    """One effect that a format has no words for: its name, and the model without it."""

    name: str
    without: Callable[[AxisModel], AxisModel]


def losses(model: AxisModel, steps: Sequence[LostEffect]) -> Iterator[LostEffect]:
    """Those of `steps` that change `model` itself."""
    return (step for step in steps if step.without(model) != model)


def reduced(model: AxisModel, steps: Sequence[LostEffect]) -> AxisModel:
    """`model` behind all `steps`, in their order: what the format says of it. Its noise and intervals go as well."""
    for step in steps:
        model = step.without(model)
    return model.model_copy(update={"noise": None, "identified": None})


def groups_but(*said: type[Group]) -> tuple[LostEffect, ...]:
    """The loss of every group of keys of an axis model but those of the kinds `said`: also of one that comes later."""
    kinds = {name: get_args(field.annotation) for name, field in AxisModel.model_fields.items()}
    lost = (name for name, found in kinds.items() if any(issubclass(k, Group) and k not in said for k in _types(found)))
    return tuple(map(_without, lost))


def _types(found: tuple[object, ...]) -> Iterator[type]:
    return (kind for kind in found if isinstance(kind, type))


def _without(name: str) -> LostEffect:
    return LostEffect(name, lambda model: model.model_copy(update={name: None}))


def part(name: str, **update: object) -> LostEffect:
    """The loss of a part of a group; `name` is that of the part's key, `update` what the group has without it."""
    first = name.split(".", maxsplit=1)[0]

    def without(model: AxisModel) -> AxisModel:
        found = getattr(model, first)
        return model if found is None else model.model_copy(update={first: found.model_copy(update=update)})

    return LostEffect(name, without)


def _put(model: AxisModel, kind: type[Group], found: Group | None) -> AxisModel:
    """`model` with another group, or none, in the place of the groups of a kind."""
    name = next(n for n, field in AxisModel.model_fields.items() if kind in get_args(field.annotation))
    return model.model_copy(update={name: found})


def offset_lost(model: AxisModel) -> AxisModel:
    """Without the constant torque beside the command."""
    return model.model_copy(update={"torque_offset": 0.0})


def delay_lost(model: AxisModel) -> AxisModel:
    """The command acts at once."""
    return model.model_copy(update={"delay_s": 0.0, "delay": None})


def gravity_of_a_slide_lost(model: AxisModel) -> AxisModel:
    """A weight that changes along a linear axis is no pendulum of an engine."""
    return _put(model, Gravity, None) if model.axis is AxisKind.LINEAR else model


def soft_limit_lost(model: AxisModel) -> AxisModel:
    """A limit that is reached softly becomes a hard one."""
    limit = model.torque_saturation
    if limit is None or limit.shape is LimitShape.HARD:
        return model
    return model.model_copy(update={"torque_saturation": limit.model_copy(update={"shape": LimitShape.HARD})})


def broken_waves_lost(model: AxisModel) -> AxisModel:
    """Cogging without the waves that do not close over a turn: an engine counts poles."""
    waves = () if model.cogging is None else model.cogging.harmonics
    whole = tuple(w for w in waves if w.periods_per_turn is not None and float(w.periods_per_turn).is_integer())
    if whole == waves:
        return model
    kept = model.cogging.model_copy(update={"harmonics": whole}) if model.cogging is not None and whole else None
    return _put(model, Cogging, kept)


def map_lost(model: AxisModel) -> AxisModel:
    """A friction map becomes the Stribeck curve that is nearest to it, with the map's own bristle and viscous part."""
    law = model.friction
    if not isinstance(law, LocalFriction):
        return model
    coulomb, static, speed = _nearest_curve(law)
    values = {"sigma0": law.sigma0, "sigma1": law.sigma1, "viscous": law.viscous}
    curve = LugreFriction(kind="lugre", coulomb=coulomb, static=static, stribeck_velocity=speed, **values)
    return model.model_copy(update={"friction": curve})


def folded(model: AxisModel) -> AxisModel:
    """The same physics with the groups `stribeck` and `presliding` put into the law of friction; no loss."""
    law = model.friction
    if isinstance(law, LocalFriction) or (model.stribeck is None and model.presliding is None):
        return model
    given = {"viscous": law.viscous, "coulomb": max(law.coulomb, 1e-12)}
    if not isinstance(law, CoulombViscousFriction):
        given |= {"static": law.coulomb if law.static is None else law.static}
        given |= {"stribeck_velocity": law.stribeck_velocity}
    if isinstance(law, LugreFriction):
        given |= {"sigma0": law.sigma0, "sigma1": law.sigma1}
    for found, keys in ((model.stribeck, ("static", "stribeck_velocity")), (model.presliding, ("sigma0", "sigma1"))):
        given |= {key: value for key in keys if found is not None and (value := getattr(found, key)) is not None}
    given = {key: value for key, value in given.items() if value is not None}
    if "sigma0" in given:
        return _with_law(model, LugreFriction(kind="lugre", **given))
    if "static" not in given:
        return _with_law(model, law)
    given.setdefault("stribeck_velocity", 0.1)
    return _with_law(model, StribeckFriction(kind="stribeck", **given))


def curve_lost(model: AxisModel) -> AxisModel:
    """Dry friction without bristles is the same at every speed."""
    law = folded(model).friction
    if not isinstance(law, StribeckFriction):
        return model
    return _with_law(model, _plain(law))


def static_lost(model: AxisModel) -> AxisModel:
    """Dry friction is the same at every speed, with bristles or without."""
    law = folded(model).friction
    if isinstance(law, StribeckFriction):
        return _with_law(model, _plain(law))
    if not isinstance(law, LugreFriction) or law.static in (None, law.coulomb):
        return model
    return _with_law(model, law.model_copy(update={"static": None}))


def bristle_lost(model: AxisModel) -> AxisModel:
    """The joint sticks where its bristles bent."""
    law = folded(model).friction
    if not isinstance(law, LugreFriction):
        return model
    if law.static in (None, law.coulomb):
        return _with_law(model, _plain(law))
    values = law.model_dump(include={"viscous", "coulomb", "static", "stribeck_velocity"})
    return _with_law(model, StribeckFriction(kind="stribeck", **values))


def _plain(law: StribeckFriction | LugreFriction) -> CoulombViscousFriction:
    return CoulombViscousFriction(kind="coulomb_viscous", viscous=law.viscous, coulomb=law.coulomb)


def _with_law(model: AxisModel, law: Friction) -> AxisModel:
    return model.model_copy(update={"friction": law, "stribeck": None, "presliding": None})


def _nearest_curve(law: LocalFriction) -> tuple[float, float, float]:
    """(coulomb, static, Stribeck velocity) nearest to the mean of a map's two sides, by least squares."""
    v, torque = np.array(law.velocities), np.array(law.torques)
    fastest = min(v[-1], -v[0])
    speeds = np.geomspace(min(v[v > 0.0][0], -v[v < 0.0][-1]), fastest, _SPEEDS)
    dry = 0.5 * (np.interp(speeds, v, torque) - np.interp(-speeds, v, torque)) - law.viscous * speeds
    best = (np.inf, float(np.mean(dry)), float(np.mean(dry)), float(fastest))
    for stribeck in np.geomspace(speeds[0], fastest, _CURVES):
        bump = np.exp(-((speeds / stribeck) ** 2))
        (coulomb, more), *_ = np.linalg.lstsq(np.column_stack([np.ones(_SPEEDS), bump]), dry, rcond=None)
        error = float(np.sum((coulomb + more * bump - dry) ** 2))
        if error < best[0] and coulomb > 0.0 and coulomb + more > 0.0:
            best = (error, float(coulomb), float(coulomb + more), float(stribeck))
    return best[1:]
