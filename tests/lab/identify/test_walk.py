"""A whole identification on the virtual axis against the truth, which nothing but these tests reads."""

from __future__ import annotations

import json

import numpy as np
import pytest

from servod.cli.app import run
from servod.client.stepped import SteppedAxis
from servod.client.virtual import virtual_session
from servod.common.errors import AnswerIsNo
from servod.common.yaml import parse_yaml, validate
from servod.formats.model.axis_model import AxisModel, axis_model_yaml, load_axis_model
from servod.lab.identify import store
from servod.lab.identify.analysis import Analysis, analyse
from servod.lab.identify.fits.cogging import GRAVITY
from servod.lab.identify.result import changes, document, identified, model_of
from servod.lab.identify.walk import identify
from servod.runtime.loop.axis import AxisState
from tests.lab.identify.conftest import Identification
from tests.lab.identify.joints import draw, steady_friction

pytestmark = pytest.mark.timeout(600)  # a whole identification is part of the first test that needs it


@pytest.fixture(params=["fine", "coarse_and_large"])
def found(request: pytest.FixtureRequest) -> Identification:
    return request.getfixturevalue(request.param)


def map_errors(analysis: Analysis, truth: AxisModel) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of the map from 5 mrad/s up, and whether each interval holds the truth."""
    errors, held = [], []
    for side, sign in ((analysis.map.positive, 1.0), (analysis.map.negative, -1.0)):
        kept = side.speed >= 0.005
        true = sign * steady_friction(truth, sign * side.speed[kept])
        errors.append(side.friction[kept] / true - 1.0)
        held.append(np.abs(side.friction[kept] - true) <= side.half_width[kept])
    return np.concatenate(errors), np.concatenate(held)


def test_stiffness_inertia_and_delay(found):
    truth, analysis = found.joint.model, found.analysis
    allowed = 0.08 if found.joint.encoder_counts == 2**20 else 0.12
    assert analysis.presliding.stiffness.value == pytest.approx(truth.friction.sigma0, rel=allowed)
    assert analysis.response.inertia.value == pytest.approx(truth.inertia, rel=0.05)
    assert analysis.response.delay_s.value == pytest.approx(truth.delay_s, abs=2e-4)
    assert analysis.presliding.stiffness.holds(truth.friction.sigma0)
    assert analysis.response.inertia.holds(truth.inertia)
    assert analysis.response.delay_s.holds(truth.delay_s)


def test_the_frequency_response_is_in_the_document(found):
    told = document(found.analysis)["frequency_response"]
    assert {len(column) for column in told.values()} == {len(told["frequency_hz"])}
    used = np.array(told["used"])
    assert np.count_nonzero(used) >= 20
    assert np.all(np.array(told["coherence"])[used] >= 0.6)
    upper = used & (np.array(told["frequency_hz"]) > 30.0)  # below, cogging disturbs it
    off = np.divide(told["fitted_gain_rad_per_nm"], told["gain_rad_per_nm"]) - 1.0
    turned = np.subtract(told["fitted_phase_deg"], told["phase_deg"])
    assert np.max(np.abs(off[upper])) < 0.04
    assert np.max(np.abs(turned[upper])) < 3.0


def test_noise_at_rest(found):
    known = found.joint.model.noise
    assert known is not None
    assert found.analysis.noise.encoder_rms.holds(known.encoder_rms)


def test_friction_map_from_5_mrad_s_up(found):
    errors, held = map_errors(found.analysis, found.joint.model)
    assert np.max(np.abs(errors)) <= 0.05
    assert np.mean(held) >= 0.9


def test_asymmetry_shows_in_the_intervals(found):
    lean = document(found.analysis)["asymmetry"]
    assert lean["low"] * lean["high"] > 0.0
    sides = found.joint.model.asymmetry
    assert np.sign(lean["value"]) == np.sign(sides.positive_dry - sides.negative_dry)


def test_cogging_is_found(found):
    (true,) = found.joint.model.cogging.harmonics
    waves = {wave.order: wave for wave in found.analysis.map.cogging}
    assert GRAVITY not in waves
    assert waves[int(true.periods_per_turn)].amplitude.value == pytest.approx(true.amplitude, rel=0.1)


def test_bristle_damping_where_the_encoder_is_fine(fine):
    truth = fine.joint.model.friction.sigma1
    assert fine.analysis.damping.value == pytest.approx(truth, rel=0.15)
    assert fine.analysis.damping.holds(truth)


def test_the_model_file_says_all_of_it(found):
    model = model_of(found.analysis)
    again = validate(parse_yaml(axis_model_yaml(model), "model"), AxisModel, "model")
    assert again == model
    speeds = np.array([-0.3, -0.02, 0.02, 0.3])
    assert steady_friction(again, speeds) == pytest.approx(steady_friction(found.joint.model, speeds), rel=0.05)
    assert "torque_gain" in again.identified.not_identifiable


def test_recordings_alone_give_the_same_numbers(fine):
    again = analyse(store.load(fine.recordings))
    assert document(again) == document(fine.analysis)


def test_the_axis_is_off_afterwards_and_progress_was_told(fine):
    assert fine.axis.session.cycle.axis.state == AxisState.DISABLED
    shares = [share for _, share in fine.told]
    assert shares == sorted(shares)


def test_an_interrupt_leaves_the_axis_off(tmp_path):
    joint = draw(3)
    axis = SteppedAxis(virtual_session(joint.model, tmp_path, joint.encoder_counts, 1), tmp_path)

    def interrupt(what: str, _share: float) -> None:
        if what == "presliding":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        identify(axis, tmp_path / "recordings", interrupt)
    assert axis.session.cycle.axis.state == AxisState.DISABLED
    assert abs(axis.session.world.truth().velocity_rad_s) < 1e-4
    assert [t.kind.value for t in store.load(tmp_path / "recordings")] == ["noise", "break_away", "break_away"]


def test_a_blocked_joint_is_said_to_be_blocked(tmp_path):
    joint = draw(5)
    friction = joint.model.friction.model_copy(update={"static": 1.0, "coulomb": 1.0})
    blocked = joint.model.model_copy(update={"friction": friction})
    session = virtual_session(joint.model, tmp_path, joint.encoder_counts, 1)
    session = virtual_session(blocked, tmp_path, joint.encoder_counts, 1, session.config)
    with pytest.raises(AnswerIsNo, match="did not move"):
        identify(SteppedAxis(session, tmp_path), tmp_path / "recordings", lambda _what, _share: None)


def test_changes_are_those_beyond_both_intervals(fine):
    before = identified(fine.analysis)
    assert changes(before, before) == []
    inertia = before.values["inertia"]
    moved = inertia.model_copy(update={k: 1.1 * getattr(inertia, k) for k in ("value", "low", "high")})
    now = before.model_copy(update={"values": before.values | {"inertia": moved}})
    (told,) = changes(before, now)
    assert told.startswith("inertia went from")


def test_a_repeat_on_a_worn_joint_says_how_much_friction_rose(fine):
    before = identified(fine.analysis)
    found = before.friction_map
    worn = [t * (1.15 if v > 0.0 else 1.0) for v, t in zip(found.velocities, found.torques, strict=True)]
    now = before.model_copy(update={"friction_map": found.model_copy(update={"torques": worn})})
    (told,) = changes(before, now)
    assert told.startswith("friction in positive direction rose by 15.0 % over the map")


def test_recordings_become_a_model_and_a_document(fine: Identification, tmp_path, capsys):
    out = tmp_path / "model.yaml"
    command = ["identify", "--recordings", str(fine.recordings), "--out", str(out), "--json"]
    assert run(command) == 0
    found = json.loads(capsys.readouterr().out)
    inertia = found["identified"]["inertia"]
    assert inertia["low"] < inertia["value"] < inertia["high"]
    assert load_axis_model(out).identified.values["inertia"].value == inertia["value"]
    assert run([*command, "--before", str(out)]) == 0
    assert json.loads(capsys.readouterr().out)["changes"] == []
