"""Experiments on an axis under a running daemon: real processes, the daemon's own recorder."""

from __future__ import annotations

import signal
import subprocess
import sys

import numpy as np
import pytest

from servod.cli.app import run
from servod.client.axis import ReferenceMotion
from servod.client.control import ControlClient
from servod.client.under_daemon import DaemonAxis
from servod.common.errors import BadInput
from servod.formats.config import load_config
from servod.formats.gains.store import GainStore
from servod.lab.identify.bounds import bounds_from
from servod.lab.identify.experiments import break_away
from servod.lab.identify.experiments.common import Bench, enable_powerless
from servod.lab.identify.fits.break_away import torque_of
from servod.lab.identify.store import Recordings, load
from servod.lab.identify.walk import identify
from tests.runtime.daemon.running import Running, running, wait_for

pytestmark = pytest.mark.serial


def test_break_away_is_measured_through_the_daemon(tmp_path):
    with running(tmp_path) as axis, ControlClient(axis.socket) as client:
        link = DaemonAxis(client, load_config(axis.folder / "axis.yaml"))
        bounds = bounds_from(link.config.limits, enable_powerless(link), None, None)
        bench = Bench(link, bounds, Recordings(tmp_path / "recordings"), np.random.default_rng(1))
        ramp = break_away.search(bench, 1.0)
        assert torque_of(ramp) == pytest.approx(0.0805, rel=0.1)  # the demo joint, forwards
        assert ramp.excitation_nm == pytest.approx(ramp.torque_nm, abs=1e-9)
        assert [len(trace) for trace in load(tmp_path / "recordings")] == [len(ramp)]
        assert (link.devices.amplifier.serial, link.devices.encoder.serial) == (1, 2)
        assert link.devices.amplifier.vendor_id is not None
        assert client.call("status")["controller"]["name"] == "identify_pd"
        link.disable()
        assert client.call("status")["axis"]["state"] == "DISABLED"
        link.give_up("over", {})
        undone(axis, client)


def undone(axis: Running, client: ControlClient) -> None:
    """The experiments' feedback has left nothing behind but lines in the history."""
    assert client.call("status")["controller"]["name"] == "demo_pd"
    active = GainStore(axis.folder / "gains").active()
    assert active is not None and active.name == "demo_pd"
    with pytest.raises(BadInput, match="no set that was active before"):
        client.call("gains_rollback")


def test_another_configuration_than_the_daemons_is_bad_input_by_its_key(tmp_path, capsys):
    with running(tmp_path) as axis:
        other = tmp_path / "other.yaml"
        text = (axis.folder / "axis.yaml").read_text()
        other.write_text(text + "encoder: {counts_per_turn: 131072}\n")
        words = ["identify", "--out", str(tmp_path / "model.yaml"), "--socket", str(axis.socket)]
        assert run([*words, "--config", str(other)]) == 2
        said = capsys.readouterr().err
        assert "--config: encoder.counts_per_turn: found 131072; allowed: 1048576, as the daemon runs with" in said
        with ControlClient(axis.socket) as client:
            assert client.call("status")["axis"]["state"] == "DISABLED"
            assert client.call("status")["controller"]["name"] == "demo_pd"


def test_whatever_ends_the_command_switches_the_axis_off_and_gives_the_gains_back(tmp_path):
    with running(tmp_path) as axis, ControlClient(axis.socket) as watcher:
        for number in (signal.SIGHUP, signal.SIGTERM):
            words = ["identify", "--out", str(tmp_path / "model.yaml"), "--config", str(axis.folder / "axis.yaml")]
            command = [sys.executable, "-m", "servod.cli", *words, "--socket", str(axis.socket)]
            identify = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            wait_for(lambda: watcher.call("status")["axis"]["motion_running"], 30.0)
            identify.send_signal(number)
            identify.send_signal(number)  # a terminal that closes does it twice
            assert identify.wait(20) == 130
            status = watcher.call("status")
            assert (status["axis"]["state"], status["axis"]["motion_running"]) == ("DISABLED", False)
            assert status["motion"]["torque_nm"] == 0.0
        undone(axis, watcher)


def test_ctrl_c_in_the_middle_of_an_experiment_switches_the_axis_off(tmp_path):
    with running(tmp_path) as axis, ControlClient(axis.socket) as client:
        link = DaemonAxis(client, load_config(axis.folder / "axis.yaml"))
        ramping = []

        def on_progress(what: str, _share: float) -> None:
            if what == "break-away":
                ramping.append(what)
                signal.setitimer(signal.ITIMER_REAL, 0.7)

        before = signal.signal(signal.SIGALRM, signal.default_int_handler)
        try:
            with pytest.raises(KeyboardInterrupt):
                identify(link, tmp_path / "recordings", on_progress)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)
        wait_for(lambda: client.call("status")["axis"]["state"] == "DISABLED")
        assert ramping == ["break-away"]
        assert client.call("status")["motion"]["torque_nm"] == 0.0
        assert [trace.kind.value for trace in load(tmp_path / "recordings")] == ["noise"]
        undone(axis, client)


class _Cut(ControlClient):
    """The first look at a motion that runs is interrupted in the middle of its request."""

    def call(self, verb, **args):
        answer = super().call(verb, **args)
        if verb == "status" and answer["axis"]["motion_running"]:
            self.close()
            raise KeyboardInterrupt
        return answer


def test_an_interrupt_stops_the_axis_before_the_recorder(tmp_path):
    """Also when it cut a request on the link's own connection."""
    with running(tmp_path) as axis, ControlClient(axis.socket) as watcher:
        link = DaemonAxis(_Cut(axis.socket), load_config(axis.folder / "axis.yaml"))
        enable_powerless(link)
        with pytest.raises(KeyboardInterrupt):
            link.run(ReferenceMotion.excite([0.0] * 10_000, [0.0] * 10_000, 0.1))
        status = watcher.call("status")
        assert (status["axis"]["state"], status["motion"]["torque_nm"]) == ("DISABLED", 0.0)
        undone(axis, watcher)


def test_an_axis_whose_connection_is_cut_is_switched_off_all_the_same(tmp_path):
    with running(tmp_path) as axis, ControlClient(axis.socket) as watcher:
        client = ControlClient(axis.socket)
        link = DaemonAxis(client, load_config(axis.folder / "axis.yaml"))
        enable_powerless(link)
        client.close()
        link.disable()
        assert watcher.call("status")["axis"]["state"] == "DISABLED"
