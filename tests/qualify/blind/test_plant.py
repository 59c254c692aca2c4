"""The trial's plant against the simulator: two programs of the same equations agree where both know them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.simulate.replay import Drive
from servod.lab.simulate.replay import replay as replayed
from servod.qualify.blind.axes import CaseAxis, CaseKind, draw_axis
from servod.qualify.blind.conceal import plain_model, true_model
from servod.qualify.blind.concealed import Draw
from servod.qualify.blind.engine import CONCEALS, description
from servod.qualify.blind.engine import run as moved_by_mujoco
from servod.qualify.blind.hidden import HIDE
from servod.qualify.blind.physics import Physics
from servod.qualify.blind.plant import rest, run

Array = NDArray[np.float64]

#: Seconds of motion, and windows of the replay.
SECONDS, HORIZON_S = 4.0, 0.25


def light(seed: int, kind: CaseKind, weight: bool) -> CaseAxis:
    """An axis whose bristle damps little, so that its stiffness and the Stribeck curve show in the motion."""
    axis = draw_axis(np.random.default_rng(seed), kind, weight)
    return replace(axis, physics=axis.physics._replace(sigma1=0.2 * axis.physics.sigma1))


def driven(axis: CaseAxis, physics: Physics) -> Drive:
    """A recording without noise, with an encoder that shows every digit."""
    reference = axis.motions.multisine(np.random.default_rng(3), SECONDS)
    out, quiet = np.zeros((len(reference), 3)), np.zeros(len(reference))
    run(physics, axis.loop._replace(ki=0.0, counts=2.0**40), rest(), reference, quiet, quiet, out)
    return Drive(1e-3 * np.arange(len(out)), out[:, 0].copy(), out[:, 1].copy(), out[:, 2].copy())


@pytest.mark.parametrize("kind", CaseKind)
def test_a_plain_joint_is_the_simulators(kind: CaseKind) -> None:
    axis = draw_axis(np.random.default_rng(5), kind, weight=True)
    drive = driven(axis, axis.physics)
    error = replayed(AxisModel.model_validate(plain_model(axis.physics)), drive, HORIZON_S).rms
    assert error < 4e-4 * axis.motions.travel


@pytest.mark.parametrize("name", sorted(HIDE))
def test_a_concealed_effect_is_the_one_of_its_name(name: str) -> None:
    """The model file that says what is concealed foretells the recording; the believed one does not."""
    axis = light(5, CaseKind.DIRECT_DRIVE, weight=False)
    concealed = HIDE[name](Draw(axis, np.random.default_rng(8), 1.5, other=False))
    axis = axis.with_travel(concealed.travel)
    physics = axis.physics._replace(**{**concealed.changes, "push_start_s": 1.0, "push_end_s": 3.0})
    concealed_model = concealed.model
    if name == "disturbance":  # an event is no part of the true model
        concealed_model = {"disturbance": {"windows": [{"start_s": 1.0, "end_s": 3.0, "torque": physics.push}]}}
    true = true_model(physics, [concealed_model])
    assert true is not None
    drive = driven(axis, physics)
    believed = plain_model(axis.physics._replace(**concealed.believed))
    before, after = (replayed(AxisModel.model_validate(m), drive, HORIZON_S).rms for m in (believed, true))
    assert after < 0.2 * before


#: A contact that bounces is another motion in each engine.
SMOOTH = sorted(set(CONCEALS) - {"backlash"})


@pytest.mark.parametrize("name", SMOOTH)
def test_an_effect_is_the_same_physics_in_another_engine(name: str) -> None:
    """Both plants conceal it: the command that is asked for is the same, and not the one without the effect."""
    axis = draw_axis(np.random.default_rng(5), CaseKind.HARMONIC_DRIVE, weight=name != "gravity")
    concealed = HIDE[name](Draw(axis, np.random.default_rng(8), 1.5, other=False))
    axis = axis.with_travel(concealed.travel)
    plain = axis.physics._replace(**concealed.believed)
    physics = axis.physics._replace(**{**concealed.changes, "push_start_s": 1.0, "push_end_s": 3.0})
    reference = axis.motions.multisine(np.random.default_rng(3), SECONDS)
    quiet = np.zeros(len(reference))
    found = []
    for follow, p in ((run, physics), (moved_by_mujoco, physics), (run, plain)):
        out = np.zeros((len(reference), 3))
        follow(p, axis.loop._replace(ki=0.0, counts=2.0**40), rest(), reference, quiet, quiet, out)
        found.append(out[:, 0])
    own, others, without = found
    # 50 us at most between two integrators
    assert np.std(others - own) < 0.05 * axis.physics.coulomb + 0.05 * np.std(without - own)
    if name not in {"stribeck", "torque_offset"}:  # these are as small as that on this axis
        assert np.std(without - own) > 4.0 * np.std(others - own)


def test_backlash_in_another_engine_has_its_gap() -> None:
    axis = draw_axis(np.random.default_rng(5), CaseKind.HARMONIC_DRIVE, weight=False)
    concealed = HIDE["backlash"](Draw(axis, np.random.default_rng(8), 1.5, other=False))
    described = description(axis.physics._replace(**concealed.changes))
    low, high = map(float, re.search(r'range="(\S+) (\S+)"', described).groups())  # type: ignore[union-attr]
    assert high - low == pytest.approx(concealed.parameters["gap"])


def test_a_closed_loop_follows_its_reference() -> None:
    axis = draw_axis(np.random.default_rng(1), CaseKind.HARMONIC_DRIVE, weight=False)
    reference = axis.motions.slow_sine(np.random.default_rng(2), SECONDS)
    errors = []
    for ki in (0.0, axis.loop.ki):
        out, quiet = np.zeros((len(reference), 3)), np.zeros(len(reference))
        run(axis.physics, axis.loop._replace(ki=ki), rest(), reference, quiet, quiet, out)
        errors.append(float(np.std(out[:, 1] - reference)))
    assert errors[1] < errors[0] < 0.1 * axis.motions.travel
    assert out[-1, 2] > 25.5  # it warms
