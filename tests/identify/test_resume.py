"""A walk that was interrupted goes on where it ended; recordings of another axis or configuration are not taken."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from servod.axis import AxisState
from servod.errors import BadInput
from servod.identify import store
from servod.identify.links import SteppedLink
from servod.identify.result import document
from servod.identify.trace import Kind, trace_of
from servod.identify.virtual import virtual_session
from servod.identify.walk import identify
from tests.identify.conftest import Identification
from tests.identify.joints import draw

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
    assert abs(link.session.world.truth().velocity_rad_s) < 1e-4
    assert len(store.load(tmp_path / "recordings")) == 5
    kept = store.Recordings(tmp_path / "recordings", "another axis", resume=True)
    assert kept.waiting == 0
    with pytest.raises(BadInput):
        store.load(tmp_path / "recordings")


def test_an_identification_knows_its_recordings(fine: Identification):
    traces = store.load(fine.recordings)
    assert fine.analysis.data_sha256 == tuple(trace.sha256 for trace in traces)
    assert len(set(fine.analysis.data_sha256)) == len(traces)


@pytest.mark.parametrize("meddle", ["exchange", "cut"])
def test_a_recording_that_is_not_the_one_that_was_made_is_refused(meddle, tmp_path):
    session = virtual_session(draw(3).model, tmp_path, 2**20, 1)
    link = SteppedLink(session)
    link.enable()
    made = store.Recordings(tmp_path, "this axis")
    made.begin(0.0)
    for seconds in (0.2, 0.3):
        rows = link.excite([0.0] * round(1000 * seconds), [0.0] * round(1000 * seconds), 0.1)
        made.keep(rows, trace_of(Kind.NOISE, rows, {}), f"motion of {seconds} s")
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
