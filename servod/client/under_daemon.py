"""The axis under a running daemon: `DaemonAxis` over its control socket, and what that and other clients need for it.

Above servod.client.control: stopping, recording, and the configuration that the daemon runs with. The daemon's own
limits, lease and heartbeats guard everything that is done.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from servod.client.axis import LOOK_S, AxisDropped, AxisReading, ReferenceMotion, Watch
from servod.client.control import ControlClient, Refused
from servod.common.errors import AnswerIsNo, BadInput, ServodError, Unreachable
from servod.common.yaml import parse_yaml, validate
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.identified import Devices
from servod.formats.protocol import TOOL_RENEW_S, Verb
from servod.formats.recording.mcap_reader import read_recording

# --- Stopping and recording ------------------------------------------------------------------------------------------
# Whatever ends a motion, the axis is stopped before all else. An interrupt may cut a request in the middle, and with it
# the connection that the client commands on; the daemon takes a stop from anybody, so that it goes out on a connection
# of its own.


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


# --- The daemon's configuration --------------------------------------------------------------------------------------
# The configuration that a running daemon has, for clients whose answer depends on its scales and limits. The daemon
# attaches its file to every recording; a recording of a moment tells it.


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


# --- The axis --------------------------------------------------------------------------------------------------------
# A trial is the daemon's as well: when this client dies in the middle, the daemon goes back to the set of before.


_POLL_S = 0.05


class DaemonAxis:
    """servod.client.axis.AxisClient on the wall clock: verbs over the control socket, recordings read from disk."""

    offset_ns: int | None = None

    def __init__(self, client: ControlClient, config: AxisConfig | None = None) -> None:
        """`config` must be the file that the daemon was started with; without one its own is asked for when it is
        wanted. Raises BadInput, naming the first other key.
        """
        self._client, self._config, self._abandoned = client, config, ""
        if config is not None:
            require_daemon_config(client, config)

    @property
    def config(self) -> AxisConfig:
        """The file's, or what the daemon attaches to its recordings."""
        self._config = self._config or daemon_config(self._client)
        return self._config

    @property
    def devices(self) -> Devices:
        """As they told the daemon at its start."""
        return Devices.of({node["role"]: node["identity"] for node in self._client.call(Verb.STATUS)["nodes"]})

    @property
    def active(self) -> tuple[str, int]:
        """The set that the loop runs."""
        running = next((row for row in self._client.call(Verb.GAINS_LIST)["gains"] if row["active"]), None)
        if running is None:
            raise AnswerIsNo("the daemon's gain set is not in its store")
        return str(running["name"]), int(running["version"])

    def status(self) -> AxisReading:
        """What `status` says."""
        document = self._client.call(Verb.STATUS)
        axis, motion = document["axis"], document["motion"]
        at_rad, reference_rad = float(motion["position_rad"]), float(motion["reference_rad"])
        return AxisReading(str(axis["state"]), bool(axis["motion_running"]), at_rad, reference_rad)

    def enable(self, reset_fault: bool = False) -> None:
        """Enable, and wait for it."""
        self._client.call(Verb.ENABLE, reset_fault=reset_fault)

    def disable(self) -> None:
        """Ask for it; an axis that is off already, or a daemon that is gone, needs none."""
        switch_off(self._client)

    def stop(self) -> None:
        """The drive's quick stop, on a connection of its own: an interrupt may have cut a request on the other."""
        quick_stop(self._client)

    def load(self, gains: GainSet) -> tuple[str, int]:
        """Put a set into the daemon's store."""
        stored = self._client.call(Verb.GAINS_LOAD, name=gains.name, text=gains.to_yaml())
        return str(stored["name"]), int(stored["version"])

    def activate(self, name: str, version: int) -> None:
        """Change to a stored set on trial; one without a certificate must be accepted by the daemon."""
        self._client.call(Verb.GAINS_ACTIVATE, name=name, version=version, trial=True)

    def keep(self, note: str, figures: dict[str, float]) -> None:
        """Make the set on trial the active one."""
        self._client.call(Verb.GAINS_KEEP, note=note, figures=figures)

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        """Change back to the active set."""
        self._client.call(Verb.GAINS_ROLLBACK, note=note, figures=figures, trial=True)

    def begin(self, motion: ReferenceMotion) -> None:
        """Start a motion and let it run, whatever becomes of this client."""
        self._start(motion, None)

    def _start(self, motion: ReferenceMotion, renew_s: float | None) -> None:
        """What the daemon refuses because the axis has dropped out is the axis's answer."""
        try:
            self._client.call(Verb.TRACK, renew_s=renew_s, **motion.arguments)
        except Refused:
            self._moves()
            raise

    def run(self, motion: ReferenceMotion, watch: Watch | None = None, look_s: float = LOOK_S) -> bytes:
        """Run the motion under the daemon's recorder and read its cycles back; it is looked at more often than asked.

        An interrupt stops the axis before anything else is waited for.
        """
        started, dropped = time.monotonic(), None
        with recording(self._client) as path:
            try:
                self._start(motion, TOOL_RENEW_S)
                while self._moves_on():
                    if watch:
                        watch(time.monotonic() - started)
                if self._abandoned:
                    raise AxisDropped("ENABLED", self._abandoned)
            except AxisDropped as error:
                dropped = error
        raw = bytes(read_recording(path).rows)
        if dropped:
            raise AxisDropped(dropped.state, dropped.why, raw)
        return raw

    def wait(self, duration_s: float) -> None:
        """Let time pass, and look on."""
        until = time.monotonic() + duration_s
        while time.monotonic() < until:
            self._moves_on()

    def _moves_on(self) -> bool:
        """Wait a little; then as `_moves`."""
        time.sleep(_POLL_S)
        return self._moves()

    def _moves(self) -> bool:
        """Whether a motion runs. Raises AxisDropped with the faults when the axis is not enabled any more."""
        status = self._client.call(Verb.STATUS)
        if status["axis"]["state"] != "ENABLED":
            why = "; ".join(f"{f['code']}: {f['cause']} {f['remedy']}" for f in status["faults"])
            raise AxisDropped(status["axis"]["state"], why)
        self._abandoned = str(status["motion"]["abandoned"])
        return bool(status["axis"]["motion_running"])
