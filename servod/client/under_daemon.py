"""A motion under a running daemon's recorder, for clients: whatever ends it, the axis is stopped before all else.

Beside servod.client.control. An interrupt may cut a request in the middle, and with it the connection that the client
commands on; the daemon takes a stop from anybody, so that it goes out on a connection of its own.
"""

from __future__ import annotations

import contextlib
import datetime
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.client.axis import MotionEnded, moving
from servod.client.control import ControlClient, Refused
from servod.client.stepped import FADE_S, Rows, Tell, cut
from servod.common.errors import AnswerIsNo, BadInput, ServodError, Unreachable
from servod.common.yaml import parse_yaml, validate
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, Provenance
from servod.formats.gains.parameters import PdParameters
from servod.formats.protocol import Verb
from servod.formats.recording.mcap_reader import read_recording
from servod.lab.identify.trace import rows_of
from servod.lab.recordings.recording import ROW
from servod.lab.verify.validation import STEP_S, ValidationMotion


def quick_stop(client: ControlClient) -> None:
    """The drive's quick stop, on a connection of its own; a daemon that is gone needs none."""
    with contextlib.suppress(ServodError), ControlClient(client.path) as own:
        own.call(Verb.STOP)


def switch_off(client: ControlClient) -> None:
    """Disable; an axis that is off already needs none. Where this connection is cut, the quick stop does it."""
    try:
        client.call(Verb.DISABLE)
    except Unreachable as error:
        if not isinstance(error, Refused):
            quick_stop(client)
    except ServodError:
        pass


@contextlib.contextmanager
def recording(client: ControlClient) -> Iterator[Path]:
    """The file that the daemon's recorder writes meanwhile; it is whole after the block.

    An interrupt in the block stops the axis before the recorder is asked for anything. Raises as ControlClient.call.
    """
    path = Path(client.call(Verb.RECORD_START)["path"])
    try:
        yield path
    except BaseException as error:
        if not isinstance(error, ServodError):
            quick_stop(client)
        with contextlib.suppress(ServodError):
            client.call(Verb.RECORD_STOP)
        raise
    client.call(Verb.RECORD_STOP)


# The configuration that a running daemon has, for clients whose answer depends on its scales and limits.
#
# Beside servod.client.control. The daemon attaches its file to every recording; a recording of a moment tells it.


#: What of a configuration decides how an axis measures and moves.
_OF_THE_AXIS = frozenset({"name", "cycle", "amplifier", "encoder", "limits"})
#: Paths: `load_config` has made them absolute, the daemon's text has not.
_PATHS = frozenset({"amplifier.eds", "encoder.eds"})


def daemon_config(client: ControlClient) -> AxisConfig:
    """The daemon's configuration; relative paths stay as they stand in its file. Raises Unreachable."""
    path = Path(client.call(Verb.RECORD_START)["path"])
    client.call(Verb.RECORD_STOP)
    attached = read_recording(path).attachments.get("config.yaml")
    if attached is None:
        raise Unreachable(f"{path}: the daemon attached no configuration")
    with contextlib.suppress(OSError):  # it may be the daemon's alone
        path.unlink()
    return validate(parse_yaml(attached.decode(), str(path)), AxisConfig, str(path))


def require_daemon_config(client: ControlClient, config: AxisConfig) -> None:
    """Refuse a configuration that describes another axis than the daemon's. Raises BadInput, naming the first key."""
    runs = dict(_values(daemon_config(client).model_dump(mode="json", include=set(_OF_THE_AXIS))))
    for key, value in _values(config.model_dump(mode="json", include=set(_OF_THE_AXIS))):
        if key not in _PATHS and value != runs[key]:
            raise BadInput(f"--config: {key}", value, f"{runs[key]}, as the daemon runs with")


def _values(section: dict[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of nested mappings with its dots, and its value."""
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _values(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


# The link to an axis under a running daemon: its verbs over the control socket, its recordings from disk.
#
# Beside `links`, which states the protocol. The daemon's own limits, lease and heartbeats guard everything that is
# done.


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


# The link to an axis under a running daemon: its verbs over the control socket, its recordings from disk.
#
# Beside `links`, which states the protocol. The trial is the daemon's own: when this client dies in the middle, the
# daemon goes back to the set of before by itself.


class DaemonDeployLink:
    """An axis on the wall clock; its configuration is what the daemon attaches to its recordings."""

    def __init__(self, client: ControlClient) -> None:
        self._client = client
        self.config = daemon_config(client)

    @property
    def active(self) -> tuple[str, int]:
        """The set that the loop runs."""
        running = next((row for row in self._client.call(Verb.GAINS_LIST)["gains"] if row["active"]), None)
        if running is None:
            raise AnswerIsNo("the daemon's gain set is not in its store")
        return str(running["name"]), int(running["version"])

    @property
    def enabled(self) -> bool:
        """Whether the axis is enabled."""
        return bool(self._client.call(Verb.STATUS)["axis"]["state"] == "ENABLED")

    def enable(self) -> None:
        """Enable, and let what is held come to rest."""
        self._client.call(Verb.ENABLE)
        time.sleep(FADE_S)

    def disable(self) -> None:
        """Ask for it; an axis that is off already, or a daemon that is gone, needs none."""
        switch_off(self._client)

    def stop(self) -> None:
        """The drive's quick stop, on a connection of its own: an interrupt may have cut a request on the other."""
        quick_stop(self._client)

    def run(self, motion: ValidationMotion, window_rad: float, tell: Tell) -> Rows:
        """Run the motion under the daemon's recorder and read its cycles back."""
        sines, started = motion.sines.tolist(), time.monotonic()
        excite = {"kind": "excite", "positions_rad": sines, "torques_nm": [0.0] * len(sines), "window_rad": window_rad}
        steps = [
            {"kind": "step", "amplitude_rad": step_rad, "duration_s": STEP_S}
            for step_rad in (motion.step_rad, -motion.step_rad)
        ]

        def told() -> None:
            tell(min(1.0, (time.monotonic() - started) / motion.duration_s))

        rows = self.record([excite], told)
        return rows if cut(rows, motion) else np.concatenate([rows, self.record(steps, told)])

    def record(self, motions: Sequence[dict[str, Any]], tell: Callable[[], None] = lambda: None) -> Rows:
        """Run motions (arguments of the verb `track`) one after the other; all cycles from the daemon's recording.

        Raises AnswerIsNo when the axis drops out or has done so, Refused or BadInput when the daemon does not take on
        a motion of an axis that is enabled. An interrupt stops the axis before anything else is waited for.
        """
        with recording(self._client) as path:
            for motion in motions:
                self._begin(motion)
                while self._moves():
                    tell()
        return np.frombuffer(read_recording(path).rows, dtype=ROW)

    def load(self, gains: GainSet) -> tuple[str, int]:
        """Put a set into the daemon's store."""
        stored = self._client.call(Verb.GAINS_LOAD, name=gains.name, text=gains.to_yaml())
        return str(stored["name"]), int(stored["version"])

    def attempt(self, name: str, version: int) -> None:
        """Change to a stored set on trial. Raises AnswerIsNo when the axis drops out under it at once."""
        self._client.call(Verb.GAINS_ACTIVATE, name=name, version=version, trial=True)
        faded = time.monotonic() + FADE_S
        while time.monotonic() < faded:
            self._moves()

    def keep(self, note: str, figures: dict[str, float]) -> None:
        """Make the set on trial the active one."""
        self._client.call(Verb.GAINS_KEEP, note=note, figures=figures)

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        """Change back to the active set."""
        self._client.call(Verb.GAINS_ROLLBACK, note=note, figures=figures, trial=True)

    def _begin(self, motion: dict[str, Any]) -> None:
        """Start a motion. What the daemon refuses because the axis has dropped out is the axis's answer."""
        try:
            self._client.call(Verb.TRACK, **motion)
        except Refused:
            self._status_while_enabled()
            raise

    def _moves(self) -> bool:
        """Wait a little; whether the motion still runs. Raises AnswerIsNo when the axis is not enabled any more."""
        time.sleep(_POLL_S)
        return bool(self._status_while_enabled()["axis"]["motion_running"])

    def _status_while_enabled(self) -> dict[str, Any]:
        """The status document. Raises AnswerIsNo with the faults when the axis is not enabled any more."""
        status = self._client.call(Verb.STATUS)
        if status["axis"]["state"] != "ENABLED":
            why = "; ".join(f"{f['code']}: {f['cause']} {f['remedy']}" for f in status["faults"])
            raise AnswerIsNo(f"the axis went to {status['axis']['state']}. {why}")
        return status
