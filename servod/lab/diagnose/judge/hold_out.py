"""Recordings that a diagnosis has not seen: how far the models are off there, in windows that are simulated freely.

Behind the engine's last stage. Nothing is fitted to these recordings, nor chosen by them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.result import HeldOutRecording, HeldOutWindow
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.recordings import Recording
from servod.lab.simulate.replay import Drive, replay, switched_on

Array = NDArray[np.float64]


def judge_held_out(
    nominal: AxisModel, extended: AxisModel, recordings: Sequence[Recording]
) -> tuple[HeldOutRecording, ...]:
    """Errors of both models, and of going on at the speed that the recording had, in each recording."""
    return tuple(
        HeldOutRecording(
            one.path.name, tuple(_window(nominal, extended, one, h) for h in SETTINGS.validation.horizons_s)
        )
        for one in recordings
    )


def _window(nominal: AxisModel, extended: AxisModel, recording: Recording, horizon_s: float) -> HeldOutWindow:
    drive, rows = switched_on(nominal, recording.driven_by(nominal)), recording.measured
    begun = replay(nominal, drive, horizon_s)
    after = begun if extended is nominal else replay(extended, drive, horizon_s)
    errors = (begun.error, after.error, coasting(drive, begun.starts))
    return HeldOutWindow(horizon_s, *(float(np.sqrt(np.mean(error[rows] ** 2))) for error in errors))


def coasting(drive: Drive, starts: NDArray[np.int64]) -> Array:
    """Position error of an axis that goes on from each of the rows `starts` at the recorded speed, rad or m."""
    last = starts[np.searchsorted(starts, np.arange(len(drive.t_s)), side="right") - 1]
    gone = drive.t_s - drive.t_s[last]
    return np.asarray(drive.position[last] + drive.motion[last, 1] * gone - drive.position)
