"""A whole deployment on a daemon and a virtual axis, and a client that is killed in the middle of a motion."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from servod.client.axis import AxisClient
from servod.client.control import ControlClient
from servod.client.open import DaemonWalkAxis
from servod.common.shipped import shipped
from servod.formats.config import load_config
from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.store import Action, GainStore
from servod.formats.model.axis_model import axis_model_yaml
from servod.lab.deploy.deployment import deploy
from servod.lab.deploy.judge import motions_in
from servod.lab.deploy.outcome import Deployment
from servod.lab.recordings.recording import Rows
from tests.lab.deploy.sets import certified_in_short, shorten_validation
from tests.lab.synthesize.designs import table1
from tests.runtime.daemon.running import at_rest, running, wait_for

pytestmark = pytest.mark.serial

#: A client that tries a set and moves; it is killed and cleans nothing up.
TRIES = """
import sys
from servod.client.axis import ReferenceMotion
from servod.client.control import ControlClient
from servod.client.under_daemon import DaemonAxis
from servod.formats.gains.gain_set import load_gains

axis = DaemonAxis(ControlClient(sys.argv[1]))
axis.enable()
axis.activate(*axis.load(load_gains(sys.argv[2])))
axis.run(ReferenceMotion.sine(0.05, 0.5, 8.0))
"""


#: A loop that skips this share of its cycles keeps no promise; it is given another chance.
BUSY_SHARE, CHANCES = 0.003, 3


@pytest.fixture
def gains(monkeypatch: pytest.MonkeyPatch) -> GainSet:
    """A certified set whose validation motion takes half of the usual time."""
    shorten_validation(monkeypatch)
    return certified_in_short()


def skipped_share(rows: Rows) -> float:
    """Share of the cycles that the loop skipped."""
    return float(rows["missed"][-1] - rows["missed"][0]) / float(rows["cycle"][-1] - rows["cycle"][0])


def tried(link: AxisClient, gains: GainSet) -> tuple[Deployment, bool]:
    """How a trial ended, and whether the loop kept time in it; the last of some chances where it did not."""
    for _ in range(CHANCES):
        done = deploy(link, gains, lambda _what, _share: None)
        kept_time = done.rows_after is not None and skipped_share(done.rows_after) < BUSY_SHARE
        if done.proven or kept_time:
            break
    return done, kept_time


@pytest.mark.timeout(300)  # a synthesis, a certificate and up to three times two motions
def test_a_set_is_deployed_on_a_daemon(gains: GainSet, tmp_path: Path) -> None:
    """The motion takes its time twice. A loop that skips cycles promises nothing, and says so."""
    assert gains.design is not None
    plant = tmp_path / "plant.yaml"
    plant.write_text(axis_model_yaml(table1()))
    more = f"encoder: {{velocity_cutoff_hz: {gains.design.velocity_cutoff_hz}}}\n"
    with running(tmp_path, plant, more) as axis:
        walk_axis = DaemonWalkAxis(axis.socket, load_config(axis.folder / "axis.yaml"))
        assert walk_axis.cutoff_hz == gains.design.velocity_cutoff_hz
        with walk_axis.deployment(tmp_path, gains, gains) as link:
            done, kept_time = tried(link, gains)
            assert link.active == ((gains.name, 1) if done.proven else ("demo_pd", 1))
            assert not link.status().enabled  # as it was found
    assert done.proven or (not kept_time and "skipped" in done.reasons[-1]), done.reasons
    assert done.ran_before is not None and done.ran_before.present == ("demo_pd", 1)
    assert done.rows_after is not None
    assert len(motions_in(done.rows_after)) == len(motions_in(done.ran_before.rows)) == 3
    last = GainStore(axis.folder / "gains").history()[-1]
    assert (last.action, last.name) == (Action.ACTIVATE if done.proven else Action.REJECT, gains.name)
    assert done.before is not None
    assert last.figures["before_slow_mrad"] == pytest.approx(done.before.document()["slow_mrad"])


def test_a_client_killed_in_a_motion_leaves_the_old_set_and_a_held_axis(tmp_path: Path) -> None:
    """The daemon goes back at once; the motion, which was checked as a whole, runs to its end, and anyone may stop."""
    with running(tmp_path) as axis, ControlClient(axis.socket) as watcher:
        command = [sys.executable, "-c", TRIES, str(axis.socket), str(shipped("gains/demo_local.yaml"))]
        with subprocess.Popen(command) as client:
            wait_for(lambda: watcher.call("status")["axis"]["motion_running"], 20.0)
            assert watcher.call("status")["controller"]["name"] == "demo_local"
            client.send_signal(signal.SIGKILL)
        wait_for(lambda: watcher.call("status")["controller"]["name"] == "demo_pd")
        left = watcher.call("status")["axis"]
        assert (left["state"], left["motion_running"]) == ("ENABLED", True)
        wait_for(at_rest(watcher))
        assert watcher.call("status")["axis"]["state"] == "ENABLED"
        assert watcher.call("disable")["state"] == "DISABLED"
        store = GainStore(axis.folder / "gains")
        active = store.active()
        assert active is not None and active.name == "demo_pd"
        assert [(h.action, h.name) for h in store.history()][-1] == (Action.REJECT, "demo_local")
