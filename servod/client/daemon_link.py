"""The link to an axis under a running daemon: its verbs over the control socket, its recordings from disk.

Beside `links`, which states the protocol. The daemon's own limits, lease and heartbeats guard everything that is done.
"""

from __future__ import annotations

import contextlib
import datetime
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.client.axis import MotionEnded, moving
from servod.client.control import ControlClient, Verb
from servod.client.daemon_config import require_daemon_config
from servod.client.under_daemon import recording, switch_off
from servod.common.errors import ServodError
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, Provenance
from servod.formats.gains.parameters import PdParameters
from servod.formats.recording.mcap_reader import read_recording
from servod.lab.identify.trace import rows_of

#: Name of the gain set that experiments run under, in the daemon's store.
GAIN_NAME = "identify_pd"
_POLL_S = 0.05


class DaemonLink:
    """An axis on the wall clock. The feedback of the experiments is only on trial: afterwards, also when this client
    dies, the gain set of before runs again and is still the stored active one.
    """

    offset_ns: int | None = None

    def __init__(self, client: ControlClient, config: AxisConfig) -> None:
        """`config` must be the file that the daemon was started with. Raises BadInput, naming the first other key."""
        require_daemon_config(client, config)
        self._client, self.config = client, config

    def enable(self) -> float:
        """Enable with zero gains."""
        self.set_gains(0.0, 0.0)
        self._client.call(Verb.ENABLE)
        return float(self._client.call(Verb.STATUS)["motion"]["position_rad"])

    def set_gains(self, position_nm_per_rad: float, velocity_nms_per_rad: float) -> None:
        """Load a PD set and run it on trial; the daemon must accept sets without a certificate for this."""
        parameters = PdParameters(
            law="pd",
            position_gain_nm_per_rad=position_nm_per_rad,
            velocity_gain_nms_per_rad=velocity_nms_per_rad,
            feedforward_inertia_kg_m2=0.0,
        )
        source = Provenance(
            author="servod", date=datetime.datetime.now(tz=datetime.UTC).date(), tool="servoctl identify"
        )
        gains = GainSet(schema_version=1, name=GAIN_NAME, parameters=parameters, provenance=source)
        self._client.call(Verb.GAINS_LOAD, name=GAIN_NAME, text=gains.to_yaml())
        self._client.call(Verb.GAINS_ACTIVATE, name=GAIN_NAME, trial=True)

    def excite(
        self, positions_rad: Sequence[float], torques_nm: Sequence[float], window_rad: float
    ) -> NDArray[np.void]:
        """Run the motion under the daemon's recorder and read its cycles back.

        An interrupt stops the axis before anything else is waited for.
        """
        with recording(self._client) as path:
            self._client.call(
                Verb.TRACK,
                kind="excite",
                positions_rad=list(positions_rad),
                torques_nm=list(torques_nm),
                window_rad=window_rad,
            )
            ended = self._wait()
        rows = moving(rows_of(read_recording(path).rows))
        if ended:
            raise MotionEnded(ended, rows)
        return rows

    def disable(self) -> None:
        """Ask for it, and for the set of before; an axis that is off already, or a daemon that is gone, needs none."""
        switch_off(self._client)
        with contextlib.suppress(ServodError):
            self._client.call(Verb.GAINS_ROLLBACK, trial=True, note="the feedback of experiments, which are over")

    def _wait(self) -> str:
        """Wait for the end of the motion; returns why it ended early, empty when it did not."""
        while True:
            time.sleep(_POLL_S)
            status = self._client.call(Verb.STATUS)
            if status["axis"]["state"] != "ENABLED":
                return f"the experiment ended with the axis in {status['axis']['state']}. {_why(status)}"
            if not status["axis"]["motion_running"]:
                return ""


def _why(status: dict[str, Any]) -> str:
    return "; ".join(f"{f['code']}: {f['cause']} {f['remedy']}" for f in status["faults"])
