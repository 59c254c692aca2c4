"""A whole identification on the virtual axis against the truth, which nothing but these tests reads.

In the same file, since a walk is dear: one that was interrupted goes on where it ended, and recordings of another axis
or configuration are not taken.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from servod.cli.app import run
from servod.client.axis import ReferenceMotion
from servod.client.stepped import SteppedAxis
from servod.client.virtual import virtual_session
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.yaml import parse_yaml, validate
from servod.formats.model.axis_model import AxisModel, axis_model_yaml, load_axis_model
from servod.formats.model.identified import Devices
from servod.lab.identify import store
from servod.lab.identify.analysis import Analysis
from servod.lab.identify.bounds import bounds_from
from servod.lab.identify.experiments.common import SPEED_SPAN_S, enable_powerless, peak_speed
from servod.lab.identify.fits.cogging import GRAVITY
from servod.lab.identify.result import changes, document, identified, model_of
from servod.lab.identify.trace import ExperimentKind, trace_of
from servod.lab.identify.walk import identify
from servod.lab.recordings.recording import moving, rows_of
from servod.runtime.loop.axis_state import AxisState
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


def test_no_experiment_is_faster_than_planned(found):
    allowed = bounds_from(found.axis.config.limits, 0.0, None, None)
    assert max(peak_speed(trace, SPEED_SPAN_S) for trace in store.load(found.recordings)) <= allowed.speed_rad_s * 1.05


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
    axis.session.run(0.2)  # without torque the bristles spring back, and ring on with little damping
    assert abs(axis.session.world.truth().velocity_rad_s) < 1e-3
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
    """The same as the walk made, so nothing changed since then."""
    out, before = tmp_path / "model.yaml", tmp_path / "before.yaml"
    before.write_text(axis_model_yaml(model_of(fine.analysis)))
    command = ["identify", "--recordings", str(fine.recordings), "--out", str(out), "--json"]
    assert run([*command, "--before", str(before)]) == 0
    found = json.loads(capsys.readouterr().out)
    same = json.loads(json.dumps(document(fine.analysis)))
    assert {key: found[key] for key in same} == same
    assert found["changes"] == []
    inertia = found["identified"]["inertia"]
    assert inertia["low"] < inertia["value"] < inertia["high"]
    assert load_axis_model(out).identified.values["inertia"].value == inertia["value"]


class CountingAxis(SteppedAxis):
    """Counts the motions that are really run."""

    motions = 0

    def run(self, *arguments):
        self.motions += 1
        return super().run(*arguments)


def again(fine: Identification, folder, **options) -> tuple[CountingAxis, object]:
    joint = fine.joint
    axis = CountingAxis(virtual_session(joint.model, folder, joint.encoder_counts, 7), folder)
    return axis, identify(axis, folder / "recordings", lambda _what, _share: None, resume=True, **options)


def test_a_complete_walk_is_not_run_again(fine: Identification, tmp_path):
    shutil.copytree(fine.recordings, tmp_path / "recordings")
    axis, analysis = again(fine, tmp_path)
    assert axis.motions == 0
    assert document(analysis) == document(fine.analysis)


def test_the_missing_experiment_is_run_and_ends_in_the_same_place(fine: Identification, tmp_path):
    shutil.copytree(fine.recordings, tmp_path / "recordings")
    listed = json.loads((tmp_path / "recordings" / store.LIST).read_text())
    listed["experiments"] = listed["experiments"][:-2]
    (tmp_path / "recordings" / store.LIST).write_text(json.dumps(listed))
    axis, analysis = again(fine, tmp_path)
    assert axis.motions == 5  # two moves to the start, two motions, and home
    assert axis.session.cycle.axis.state == AxisState.DISABLED
    assert analysis.data_sha256[:-2] == fine.analysis.data_sha256[:-2]
    assert analysis.data_sha256[-1] != fine.analysis.data_sha256[-1]
    assert analysis.response.inertia == fine.analysis.response.inertia
    for side, before in ((analysis.map.positive, fine.analysis.map.positive),):
        told = np.interp(0.1, side.speed, side.friction)
        assert told == pytest.approx(np.interp(0.1, before.speed, before.friction), rel=0.02)


def test_an_interrupt_anywhere_leaves_the_axis_off_and_the_recordings(tmp_path):
    joint = draw(3)

    class Interrupted(CountingAxis):
        """Ctrl-C in the middle of the fifth motion."""

        def run(self, motion):
            return super().run(motion, *([self.interrupt] if self.motions == 5 else []))

        def interrupt(self, _passed_s):
            raise KeyboardInterrupt

    axis = Interrupted(virtual_session(joint.model, tmp_path, joint.encoder_counts, 1), tmp_path)
    with pytest.raises(KeyboardInterrupt):
        identify(axis, tmp_path / "recordings", lambda _what, _share: None)
    assert axis.session.cycle.axis.state == AxisState.DISABLED
    assert axis.session.latest.torque_nm == 0.0
    assert abs(axis.session.world.truth().velocity_rad_s) < 1e-3  # bristles still relax
    assert len(store.load(tmp_path / "recordings")) == 5
    assert store.Recordings(tmp_path / "recordings", "another axis", resume=True).waiting == 0
    assert len(store.load(tmp_path / "recordings")) == 5


def rested(axis: SteppedAxis, cycles: int):
    """The cycles of a rest."""
    return moving(rows_of(axis.run(ReferenceMotion.excite([0.0] * cycles, [0.0] * cycles, 0.1))))


def recorded(folder, session, *durations_s: float) -> None:
    """Rests of these durations, recorded again in `folder`."""
    axis = SteppedAxis(session, folder)
    enable_powerless(axis)
    made = store.Recordings(folder, "this axis")
    made.begin(0.0)
    for seconds in durations_s:
        rows = rested(axis, round(1000 * seconds))
        made.keep(rows, trace_of(ExperimentKind.NOISE, rows, {}), f"motion of {seconds} s")


def test_a_walk_that_is_refused_leaves_the_recordings_of_the_model_that_stands(tmp_path):
    session = virtual_session(draw(3).model, tmp_path, 2**20, 1)
    recorded(tmp_path / "recordings", session, 0.1, 0.2)
    before = [trace.sha256 for trace in store.load(tmp_path / "recordings")]

    class Refused(CountingAxis):
        def enable(self, reset_fault: bool = False) -> None:
            raise AnswerIsNo("a fault is latched")

    with pytest.raises(AnswerIsNo, match="latched"):
        identify(Refused(session, tmp_path), tmp_path / "recordings", lambda _what, _share: None)
    assert [trace.sha256 for trace in store.load(tmp_path / "recordings")] == before


def test_a_new_walk_sets_the_earlier_ones_aside_whole(tmp_path):
    session = virtual_session(draw(3).model, tmp_path, 2**20, 1)
    hashes = []
    for durations_s in ((0.1, 0.2), (0.15,), (0.12, 0.13, 0.14)):
        recorded(tmp_path, session, *durations_s)
        hashes.append([trace.sha256 for trace in store.load(tmp_path)])
    folders = (tmp_path / "before_01", tmp_path / "before_02", tmp_path)
    assert [[trace.sha256 for trace in store.load(folder)] for folder in folders] == hashes


def test_a_walk_that_leaves_the_recorded_one_halfway_sets_all_of_it_aside(tmp_path):
    session = virtual_session(draw(3).model, tmp_path, 2**20, 1)
    recorded(tmp_path, session, 0.1, 0.2, 0.3)
    before = [trace.sha256 for trace in store.load(tmp_path)]
    again = store.Recordings(tmp_path, "this axis", resume=True)
    first = again.recorded(ExperimentKind.NOISE, "motion of 0.1 s")
    assert again.recorded(ExperimentKind.NOISE, "another motion") is None
    assert [trace.sha256 for trace in store.load(tmp_path)] == before
    rows = rested(SteppedAxis(session, tmp_path), 50)
    new = again.keep(rows, trace_of(ExperimentKind.NOISE, rows, {}), "another motion")
    assert [trace.sha256 for trace in store.load(tmp_path)] == [first.sha256, new.sha256]
    assert [trace.sha256 for trace in store.load(tmp_path / "before_01")] == before


def test_an_identification_knows_its_devices(fine: Identification, tmp_path):
    """Those of a virtual axis are anybody's; what an axis says of its own goes into the list and the model."""
    assert store.load_devices(fine.recordings) == fine.analysis.devices == Devices()
    assert identified(fine.analysis).devices is None
    own = Devices.model_validate({"amplifier": {"serial": 4711}})
    axis = SteppedAxis(virtual_session(draw(3).model, tmp_path, 2**20, 1), tmp_path)
    enable_powerless(axis)
    rows = rested(axis, 50)
    made = store.Recordings(tmp_path / "made", "this axis")
    made.begin(0.0, own)
    made.keep(rows, trace_of(ExperimentKind.NOISE, rows, {}), "a motion")
    assert store.load_devices(tmp_path / "made") == own
    model = model_of(replace(fine.analysis, devices=own))
    assert model.identified is not None and model.identified.devices == own


def test_an_identification_knows_its_recordings(fine: Identification):
    traces = store.load(fine.recordings)
    assert fine.analysis.data_sha256 == tuple(trace.sha256 for trace in traces)
    assert len(set(fine.analysis.data_sha256)) == len(traces)


@pytest.mark.parametrize("meddle", ["exchange", "cut"])
def test_a_recording_that_is_not_the_one_that_was_made_is_refused(meddle, tmp_path):
    recorded(tmp_path, virtual_session(draw(3).model, tmp_path, 2**20, 1), 0.2, 0.3)
    first, second = sorted(tmp_path.glob("*.mcap"))
    assert [trace.sha256 for trace in store.load(tmp_path)] == [store.file_sha256(first), store.file_sha256(second)]
    if meddle == "exchange":
        shutil.copy(second, first)
    else:
        first.write_bytes(first.read_bytes()[:-2000])
    again = store.Recordings(tmp_path, "this axis", resume=True)
    with pytest.raises(BadInput, match=rf"{first.name}: found a file that was changed or cut short"):
        again.recorded(ExperimentKind.NOISE, "motion of 0.2 s")
    with pytest.raises(BadInput, match=first.name):
        store.load(tmp_path)
