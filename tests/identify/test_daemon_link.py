"""Experiments on an axis under a running daemon: real processes, the daemon's own recorder."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from servod.config import load_config
from servod.control import ControlClient
from servod.identify.bounds import bounds_from
from servod.identify.daemon_link import DaemonLink
from servod.identify.experiments import break_away
from servod.identify.experiments.common import Bench
from servod.identify.fits.break_away import torque_of
from servod.identify.store import Recordings, load
from servod.identify.walk import identify
from tests.daemon.running import running, wait_for

pytestmark = pytest.mark.serial


def test_break_away_is_measured_through_the_daemon(tmp_path):
    with running(tmp_path) as axis, ControlClient(axis.socket) as client:
        link = DaemonLink(client, load_config(axis.folder / "axis.yaml"))
        bounds = bounds_from(link.config.limits, link.enable(), None, None)
        bench = Bench(link, bounds, Recordings(tmp_path / "recordings"), np.random.default_rng(1))
        ramp = break_away.search(bench, 1.0)
        assert torque_of(ramp) == pytest.approx(0.0805, rel=0.1)  # the demo joint, forwards
        assert ramp.excitation_nm == pytest.approx(ramp.torque_nm, abs=1e-9)
        assert [len(trace) for trace in load(tmp_path / "recordings")] == [len(ramp)]
        link.disable()
        assert client.call("status")["axis"]["state"] == "DISABLED"


def test_ctrl_c_in_the_middle_of_an_experiment_switches_the_axis_off(tmp_path):
    with running(tmp_path) as axis, ControlClient(axis.socket) as client:
        link = DaemonLink(client, load_config(axis.folder / "axis.yaml"))
        ramping = []

        def tell(what: str, _share: float) -> None:
            if what == "break-away":
                ramping.append(what)
                signal.setitimer(signal.ITIMER_REAL, 0.7)

        before = signal.signal(signal.SIGALRM, signal.default_int_handler)
        try:
            with pytest.raises(KeyboardInterrupt):
                identify(link, tmp_path / "recordings", tell)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)
        wait_for(lambda: client.call("status")["axis"]["state"] == "DISABLED")
        assert ramping == ["break-away"]
        assert client.call("status")["motion"]["torque_nm"] == 0.0
        assert [trace.kind.value for trace in load(tmp_path / "recordings")] == ["noise"]
