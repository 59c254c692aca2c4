"""The speed bound: no experiment is faster than it, and where nothing can be told below it, that is said."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from servod.client.stepped import SteppedAxis
from servod.client.virtual import virtual_session
from servod.common.errors import AnswerIsNo
from servod.common.shipped import shipped
from servod.formats.config import load_config
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.identify.bounds import bounds_from
from servod.lab.identify.experiments import kick
from servod.lab.identify.experiments.common import Bench, enable_powerless
from servod.lab.identify.fits import kick as kick_fit
from servod.lab.identify.trace import ExperimentKind, RecordedMotion
from tests.lab.identify.joints import Drawn, draw


class Unkept:
    """A keeper that keeps nothing."""

    def recorded(self, _kind, _motion) -> None:
        return None

    def keep(self, _rows, trace: RecordedMotion, _motion: str) -> RecordedMotion:
        return trace


class Truth:
    """The highest true speed of a virtual joint, cycle by cycle."""

    def __init__(self, session) -> None:
        self.peak_rad_s, self._session, self._step = 0.0, session, session.cycle.step
        session.cycle.step = self._watched

    def _watched(self, *arguments) -> None:
        self._step(*arguments)
        self.peak_rad_s = max(self.peak_rad_s, abs(self._session.world.truth().velocity_rad_s))


def bench_of(joint: Drawn, folder, speed_rad_s: float) -> tuple[Bench, Truth]:
    session = virtual_session(joint.model, folder, joint.encoder_counts, 1)
    axis = SteppedAxis(session, folder)
    bounds = bounds_from(axis.config.limits, enable_powerless(axis), None, speed_rad_s)
    return Bench(axis, bounds, Unkept(), np.random.default_rng(1)), Truth(session)


def break_away(joint: Drawn) -> tuple[float, float]:
    """True static friction of both directions, N*m."""
    sides, static = joint.model.asymmetry, joint.model.friction.static
    return static * sides.positive_dry, static * sides.negative_dry


@pytest.mark.parametrize(("bits", "speed_rad_s"), [(20, 0.35), (17, 0.5), (20, 1.0)])
def test_kicks_keep_to_the_speed_and_tell_inertia(bits, speed_rad_s, tmp_path):
    joint = draw(31, bits=bits)
    bench, truth = bench_of(joint, tmp_path, speed_rad_s)
    kicks = kick.run(bench, break_away(joint))
    assert truth.peak_rad_s <= speed_rad_s
    assert kick_fit.fit(kicks).inertia == pytest.approx(joint.model.inertia, rel=0.4)


@pytest.mark.parametrize(
    ("amplitude", "waves", "phase", "speed_rad_s"), [(0.05, 40, 0.5, 0.4), (0.06, 30, 1.4, 0.45), (0.05, 30, 0.0, 0.25)]
)
def test_a_joint_that_leaves_a_hill_is_no_faster_than_allowed(amplitude, waves, phase, speed_rad_s, tmp_path):
    """What held it in its valley, as much as its friction, does not hold it beyond."""
    hill = {"harmonics": [{"amplitude": amplitude, "periods_per_turn": waves, "phase": phase}]}
    plain = load_axis_model(shipped("gains/axes/table1_joint.yaml"))
    joint = AxisModel.model_validate(plain.model_dump(exclude_unset=True) | {"cogging": hill})
    session = virtual_session(joint, tmp_path, 2**17, 1)
    axis = SteppedAxis(session, tmp_path)
    bounds = bounds_from(axis.config.limits, enable_powerless(axis), None, speed_rad_s)
    bench, truth = Bench(axis, bounds, Unkept(), np.random.default_rng(1)), Truth(session)
    with contextlib.suppress(AnswerIsNo):  # that it cannot be told at this speed is an answer
        kick.run(bench, (0.071, 0.071))
    assert 0.0 < truth.peak_rad_s <= speed_rad_s


UNEVEN = {"positive_dry": 1.1, "negative_dry": 0.9}
#: The joint stands on a slope: that way it breaks away at little, and a hill of three times as much is before it.
SLOPE = {"harmonics": [{"amplitude": 0.02, "periods_per_turn": 22, "phase": 1.4}]}


@pytest.mark.parametrize(
    ("config", "parts", "break_away_nm"),
    [("gains/config/virtual.yaml", {}, (0.077, 0.063)), (None, {"cogging": SLOPE}, (0.097, 0.043))],
    ids=["viscous friction and a high limit of speed", "cogging"],
)
def test_a_joint_that_a_longer_kick_makes_no_faster_is_kicked_harder(config, parts, break_away_nm, tmp_path):
    plain = load_axis_model(shipped("gains/axes/table1_joint.yaml")).model_dump(exclude_unset=True)
    joint = AxisModel.model_validate(plain | {"asymmetry": UNEVEN} | parts)
    session = virtual_session(joint, tmp_path, None, 1, load_config(shipped(config)) if config else None)
    axis = SteppedAxis(session, tmp_path)
    bounds = bounds_from(axis.config.limits, enable_powerless(axis), None, None)
    bench, truth = Bench(axis, bounds, Unkept(), np.random.default_rng(1)), Truth(session)
    kicks = kick.run(bench, break_away_nm)
    assert truth.peak_rad_s <= bounds.most_rad_s
    assert kick_fit.fit(kicks).inertia == pytest.approx(joint.inertia, rel=0.5)


@pytest.mark.parametrize(
    ("bits", "speed_rad_s", "said"),
    [
        (17, 0.1, "at this speed with this encoder: it shows kicks from 0.19 rad/s on"),
        (20, 0.15, "at this speed: a kick of"),
        (17, 0.2, "at this speed: a kick of"),
    ],
)
def test_where_no_kick_below_the_speed_tells_it_is_said(bits, speed_rad_s, said, tmp_path):
    joint = draw(31, bits=bits)
    bench, truth = bench_of(joint, tmp_path, speed_rad_s)
    with pytest.raises(AnswerIsNo, match=f"inertia is not identifiable {said}"):
        kick.run(bench, break_away(joint))
    assert truth.peak_rad_s <= speed_rad_s


def test_a_joint_that_is_faster_than_allowed_ends_the_walk(tmp_path):
    bench, truth = bench_of(draw(31, bits=20), tmp_path, 0.1)
    torque = np.where(np.arange(100) < 20, 0.1, 0.0)
    with pytest.raises(AnswerIsNo, match=r"went at .* rad/s in the experiment kick, 0.1 are allowed"):
        bench.run(ExperimentKind.KICK, np.zeros(100), torque, 0.1, {})
    assert truth.peak_rad_s > 0.1


def test_a_path_that_is_faster_than_allowed_is_not_begun(tmp_path):
    bench, truth = bench_of(draw(31, bits=20), tmp_path, 0.1)
    with pytest.raises(AnswerIsNo, match="would go at"):
        bench.run(ExperimentKind.FRICTION_MAP, np.linspace(0.0, 0.02, 100), np.zeros(100), 0.1, {})
    assert truth.peak_rad_s < 0.01
