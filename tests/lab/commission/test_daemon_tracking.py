"""The comparison on a daemon's axis: another set than the deployed one, refused motions, a daemon that dies."""

from __future__ import annotations

from pathlib import Path

import pytest

from servod.client.control import ControlClient
from servod.common.errors import AnswerIsNo, BadInput, Unreachable
from servod.formats.config import load_config
from servod.lab.commission.steps.validate import measure_on_daemon
from servod.lab.tracking.metrics import STEPS_MRAD
from tests.runtime.daemon.running import running

pytestmark = pytest.mark.serial


def test_only_the_deployed_set_is_measured_and_a_refusal_is_no_death(tmp_path: Path) -> None:
    with running(tmp_path, travel_rad=0.005) as axis:  # too narrow for any of the motions
        config = load_config(axis.folder / "axis.yaml")
        with pytest.raises(AnswerIsNo, match="runs demo_pd version 1, but deployed version 2 was deployed"):
            measure_on_daemon(axis.socket, config, ("deployed", 2), lambda _share: None)
        coarse = config.encoder.model_copy(update={"counts_per_turn": 1000})
        with pytest.raises(BadInput, match=r"encoder\.counts_per_turn"):
            measure_on_daemon(
                axis.socket, config.model_copy(update={"encoder": coarse}), ("demo_pd", 1), lambda _share: None
            )
        found, refused = measure_on_daemon(axis.socket, config, ("demo_pd", 1), lambda _share: None)
        assert found is None
        assert [line.partition(":")[0] for line in refused] == ["paper", *(f"{mrad:g}" for mrad in STEPS_MRAD)]
        assert all("limits.position" in line for line in refused)
        with ControlClient(axis.socket) as client:
            assert client.call("status")["axis"]["state"] == "DISABLED"

        def die(share: float) -> None:
            if share > 0.5:  # before the last motion
                axis.daemon.kill()
                axis.daemon.wait()

        with pytest.raises(Unreachable):
            measure_on_daemon(axis.socket, config, ("demo_pd", 1), die)
