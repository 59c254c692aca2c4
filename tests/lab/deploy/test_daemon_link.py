"""A trial under a running daemon: real processes, and a client that leaves without keeping what it tried."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servod.client.axis import ReferenceMotion
from servod.client.control import ControlClient
from servod.client.under_daemon import DaemonAxis
from servod.common.errors import AnswerIsNo
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import load_gains, pd_set
from servod.formats.gains.store import Action, GainStore
from servod.lab.deploy.deployment import FADE_S, run_validation
from servod.lab.deploy.judge import motions_in
from servod.lab.verify.validation import Array, ValidationMotion
from tests.runtime.daemon.running import running, wait_for

pytestmark = pytest.mark.serial


#: Swings by itself with 16 mrad to each side, on an axis that stands still.
WILD = pd_set("wild", 2000.0, 0.0)


class Short(ValidationMotion):
    """Half a second of sine in place of ten."""

    @property
    def sines(self) -> Array:
        return 0.01 * np.sin(np.linspace(0.0, 2.0 * np.pi, 500))


def test_a_trial_is_run_kept_and_undone(tmp_path: Path) -> None:
    motion = Short(0.001, 0.01, 0.01, 8.0, 0.002)
    local = load_gains(shipped("gains/demo_local.yaml"))
    with running(tmp_path, travel_rad=0.013) as axis:
        with ControlClient(axis.socket) as client:
            link = DaemonAxis(client)
            assert link.config.name == "tried"
            with pytest.raises(AnswerIsNo, match="trial"):
                link.keep("nothing to keep", {})
            with pytest.raises(AnswerIsNo, match="trial"):
                link.give_up("nothing to give up", {})
            link.enable()
            link.activate(*link.load(local))
            parts = motions_in(run_validation(link, motion, 0.1))
            spans_s = [1e-9 * float(part["time_ns"][-1] - part["time_ns"][0]) for part in parts]  # rows may be skipped
            assert spans_s == pytest.approx([0.5, 1.0, 1.0], abs=0.05)
            assert link.active == ("demo_local", 1)
            link.keep("good", {"after_slow_mrad": 0.1})
            link.activate(*link.load(load_gains(shipped("gains/demo_pd_dob.yaml"))))
            assert link.active == ("demo_pd_dob", 1)
            with pytest.raises(AnswerIsNo, match=r"the axis went to .*((POSITION|SPEED)_LIMIT|OSCILLATES)"):
                link.activate(*link.load(WILD))
                link.wait(FADE_S)
                link.run(ReferenceMotion.step(0.01, 0.5))  # and swings beyond the range
            with pytest.raises(AnswerIsNo, match="the axis went to"):
                link.run(ReferenceMotion.step(0.01, 0.5))
        with ControlClient(axis.socket) as watcher:  # the client of the trial has gone
            wait_for(lambda: watcher.call("status")["controller"]["name"] == "demo_local")
            assert watcher.call("gains_rollback")["name"] == "demo_pd"
            watcher.call("disable")
    history = GainStore(axis.folder / "gains").history()
    assert [(h.action, h.name) for h in history if h.action in (Action.REJECT, Action.ROLLBACK)] == [
        (Action.REJECT, "wild"),
        (Action.ROLLBACK, "demo_pd"),
    ]
    assert [h.figures for h in history if h.note == "good"] == [{"after_slow_mrad": 0.1}]


def test_an_interrupt_stops_the_axis_before_the_recorder(tmp_path: Path) -> None:
    """Also when it cut a request on the link's own connection."""
    motion = ReferenceMotion.sine(0.05, 0.5, 10.0)
    with running(tmp_path) as axis, ControlClient(axis.socket) as watcher:
        with ControlClient(axis.socket) as client:
            link = DaemonAxis(client)
            link.enable()

            def interrupt(_passed_s: float) -> None:
                client.close()
                raise KeyboardInterrupt

            with pytest.raises(KeyboardInterrupt):
                link.run(motion, interrupt)
        status = watcher.call("status")
        assert (status["axis"]["state"], status["motion"]["torque_nm"]) == ("DISABLED", 0.0)
        assert status["controller"]["name"] == "demo_pd"
