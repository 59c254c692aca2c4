"""What a client may rely on of every axis, whatever is behind it: the same walk in virtual time and under a daemon."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from servod.client.axis import AxisClient, AxisDropped, ReferenceMotion
from servod.client.control import ControlClient
from servod.client.stepped import SteppedAxis
from servod.client.under_daemon import DaemonAxis
from servod.client.virtual import virtual_session
from servod.common.errors import AnswerIsNo, ServodError
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import load_gains, pd_set
from servod.formats.gains.store import Action, GainStore
from servod.formats.model.axis_model import load_axis_model
from servod.lab.recordings.recording import moving, rows_of
from tests.runtime.daemon.running import running

PRESENT = load_gains(shipped("gains/demo_pd.yaml"))
TRIED = pd_set("tried", 2.0, 0.1)


@contextlib.contextmanager
def stepped(folder: Path) -> Iterator[AxisClient]:
    joint = load_axis_model(shipped("gains/axes/demo_joint.yaml"))
    axis = SteppedAxis(virtual_session(joint, folder, 2**20, 1), folder, PRESENT)
    axis.run_active()
    yield axis


@contextlib.contextmanager
def under_daemon(folder: Path) -> Iterator[AxisClient]:
    with running(folder) as daemon, ControlClient(daemon.socket) as client:
        yield DaemonAxis(client)


@pytest.fixture(params=[stepped, pytest.param(under_daemon, marks=pytest.mark.serial)])
def axis(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[AxisClient]:
    with request.param(tmp_path) as opened:
        yield opened


def test_an_axis_is_enabled_moved_and_switched_off(axis: AxisClient) -> None:
    assert not axis.status().enabled
    axis.enable()
    assert axis.status().enabled and not axis.status().moves
    before_rad, passed_s = axis.status().reference_rad, [0.0]
    rows = moving(rows_of(axis.run(ReferenceMotion.step(0.01, 0.3), passed_s.append)))
    assert rows["reference_rad"] == pytest.approx(before_rad + 0.01)
    assert len(rows) == pytest.approx(300, abs=30) and passed_s == sorted(passed_s)
    axis.begin(ReferenceMotion.sine(0.01, 1.0, 60.0))
    axis.wait(0.2)
    assert axis.status().moves
    axis.stop()
    axis.disable()
    assert axis.status().state == "DISABLED"


def test_what_is_refused_is_told_and_an_axis_that_is_off_has_dropped_out(axis: AxisClient) -> None:
    for motion in (ReferenceMotion.step(0.01, 0.3), ReferenceMotion.table([0.0, 0.0])):
        with pytest.raises(AxisDropped, match="the axis went to DISABLED") as dropped:
            axis.run(motion)
        assert len(moving(rows_of(dropped.value.raw))) == 0
    axis.enable()
    with pytest.raises(ServodError, match=r"limits\.position_min_rad") as refused:
        axis.run(ReferenceMotion.step(50.0, 0.3))
    assert not isinstance(refused.value, AxisDropped) and axis.status().enabled


def test_a_set_is_tried_given_up_and_kept(axis: AxisClient, tmp_path: Path) -> None:
    for verdict in (axis.keep, axis.give_up):
        with pytest.raises(AnswerIsNo, match="no gain set is on trial"):
            verdict("nothing was tried", {})
    axis.activate(*axis.load(TRIED))
    assert axis.active == ("tried", 1)
    axis.give_up("as it was", {"before_slow_mrad": 1.0})
    assert axis.active == (PRESENT.name, 1)
    axis.activate(*axis.load(TRIED))
    axis.keep("better", {})
    assert axis.active == ("tried", 1)
    history = [(entry.action, entry.note) for entry in GainStore(tmp_path / "gains").history()]
    assert history[-2:] == [(Action.REJECT, "as it was"), (Action.ACTIVATE, "better")]
