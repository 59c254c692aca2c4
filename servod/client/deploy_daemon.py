"""The link to an axis under a running daemon: its verbs over the control socket, its recordings from disk.

Beside `links`, which states the protocol. The trial is the daemon's own: when this client dies in the middle, the
daemon goes back to the set of before by itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from servod.client.control import ControlClient, Refused, Verb
from servod.client.daemon_config import daemon_config
from servod.client.links import FADE_S, Rows, Tell, cut
from servod.client.under_daemon import quick_stop, recording, switch_off
from servod.common.errors import AnswerIsNo
from servod.formats.gains.gain_set import GainSet
from servod.formats.recording.mcap_reader import read_recording
from servod.lab.recordings.rows import ROW
from servod.lab.verify.validation import STEP_S, ValidationMotion

_POLL_S = 0.05


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

        Raises AnswerIsNo when the axis drops out or has done so, Refused when the daemon does not take on a motion of
        an axis that is enabled. An interrupt stops the axis before anything else is waited for.
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
