"""A walk that was interrupted goes on where it ended; recordings of another axis or configuration are not taken."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from servod.client.axis import ReferenceMotion
from servod.client.stepped import SteppedAxis
from servod.client.virtual import virtual_session
from servod.common.errors import AnswerIsNo, BadInput
from servod.lab.identify import store
from servod.lab.identify.experiments.common import enable_powerless
from servod.lab.identify.result import document
from servod.lab.identify.trace import ExperimentKind, trace_of
from servod.lab.identify.walk import identify
from servod.lab.recordings.recording import moving, rows_of
from servod.runtime.loop.axis import AxisState
from tests.lab.identify.conftest import Identification
from tests.lab.identify.joints import draw

pytestmark = pytest.mark.timeout(600)  # a whole identification is part of the first test that needs it


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
    """Rests of these durations, recorded anew in `folder`."""
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
