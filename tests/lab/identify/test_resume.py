"""A walk that was interrupted goes on where it ended; recordings of another axis or configuration are not taken."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from servod.client.stepped import SteppedLink
from servod.client.virtual import virtual_session
from servod.common.errors import AnswerIsNo, BadInput
from servod.lab.identify import store
from servod.lab.identify.result import document
from servod.lab.identify.trace import Kind, trace_of
from servod.lab.identify.walk import identify
from servod.runtime.loop.axis import AxisState
from tests.lab.identify.conftest import Identification
from tests.lab.identify.joints import draw

pytestmark = pytest.mark.timeout(600)  # a whole identification is part of the first test that needs it


class CountingLink(SteppedLink):
    """Counts the motions that are really run."""

    motions = 0

    def excite(self, *arguments):
        self.motions += 1
        return super().excite(*arguments)


def again(fine: Identification, folder, **options) -> tuple[CountingLink, object]:
    joint = fine.joint
    link = CountingLink(virtual_session(joint.model, folder, joint.encoder_counts, 7))
    return link, identify(link, folder / "recordings", lambda _what, _share: None, resume=True, **options)


def test_a_complete_walk_is_not_run_again(fine: Identification, tmp_path):
    shutil.copytree(fine.recordings, tmp_path / "recordings")
    link, analysis = again(fine, tmp_path)
    assert link.motions == 0
    assert document(analysis) == document(fine.analysis)


def test_the_missing_experiment_is_run_and_ends_in_the_same_place(fine: Identification, tmp_path):
    shutil.copytree(fine.recordings, tmp_path / "recordings")
    listed = json.loads((tmp_path / "recordings" / store.LIST).read_text())
    listed["experiments"] = listed["experiments"][:-2]
    (tmp_path / "recordings" / store.LIST).write_text(json.dumps(listed))
    link, analysis = again(fine, tmp_path)
    assert link.motions == 5  # two moves to the start, two motions, and home
    assert link.session.cycle.axis.state == AxisState.DISABLED
    assert analysis.data_sha256[:-2] == fine.analysis.data_sha256[:-2]
    assert analysis.data_sha256[-1] != fine.analysis.data_sha256[-1]
    assert analysis.response.inertia == fine.analysis.response.inertia
    for side, before in ((analysis.map.positive, fine.analysis.map.positive),):
        told = np.interp(0.1, side.speed, side.friction)
        assert told == pytest.approx(np.interp(0.1, before.speed, before.friction), rel=0.02)


def test_an_interrupt_anywhere_leaves_the_axis_off_and_the_recordings(tmp_path):
    joint = draw(3)

    class Interrupted(CountingLink):
        """Ctrl-C in the middle of the fifth motion."""

        def excite(self, *arguments):
            if self.motions == 5:
                self._watch = self.interrupt
            return super().excite(*arguments)

        def interrupt(self, _passed_s):
            raise KeyboardInterrupt

    link = Interrupted(virtual_session(joint.model, tmp_path, joint.encoder_counts, 1))
    with pytest.raises(KeyboardInterrupt):
        identify(link, tmp_path / "recordings", lambda _what, _share: None)
    assert link.session.cycle.axis.state == AxisState.DISABLED
    assert link.session.latest.torque_nm == 0.0
    assert abs(link.session.world.truth().velocity_rad_s) < 1e-3  # bristles still relax
    assert len(store.load(tmp_path / "recordings")) == 5
    assert store.Recordings(tmp_path / "recordings", "another axis", resume=True).waiting == 0
    assert len(store.load(tmp_path / "recordings")) == 5


def recorded(folder, session, *durations_s: float) -> None:
    """Rests of these durations, recorded anew in `folder`."""
    link = SteppedLink(session)
    link.enable()
    made = store.Recordings(folder, "this axis")
    made.begin(0.0)
    for seconds in durations_s:
        rows = link.excite([0.0] * round(1000 * seconds), [0.0] * round(1000 * seconds), 0.1)
        made.keep(rows, trace_of(Kind.NOISE, rows, {}), f"motion of {seconds} s")


def test_a_walk_that_is_refused_leaves_the_recordings_of_the_model_that_stands(tmp_path):
    session = virtual_session(draw(3).model, tmp_path, 2**20, 1)
    recorded(tmp_path / "recordings", session, 0.1, 0.2)
    before = [trace.sha256 for trace in store.load(tmp_path / "recordings")]

    class Refused(CountingLink):
        def enable(self) -> float:
            raise AnswerIsNo("a fault is latched")

    with pytest.raises(AnswerIsNo, match="latched"):
        identify(Refused(session), tmp_path / "recordings", lambda _what, _share: None)
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
    first = again.recorded(Kind.NOISE, "motion of 0.1 s")
    assert again.recorded(Kind.NOISE, "another motion") is None
    assert [trace.sha256 for trace in store.load(tmp_path)] == before
    rows = SteppedLink(session).excite([0.0] * 50, [0.0] * 50, 0.1)
    new = again.keep(rows, trace_of(Kind.NOISE, rows, {}), "another motion")
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
        again.recorded(Kind.NOISE, "motion of 0.2 s")
    with pytest.raises(BadInput, match=first.name):
        store.load(tmp_path)
