"""The tracking comparison on an axis under a daemon: the deployed law alone, as far as the axis's limits allow.

Beside the step that validates.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from pathlib import Path

from servod.client.axis import AxisClient, ReferenceMotion
from servod.client.control import ControlClient, Refused, RemoteBadInput
from servod.client.under_daemon import DaemonAxis, require_daemon_config
from servod.common.errors import AnswerIsNo
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.lab.tracking.metrics import HOLD_S, PAPER_S, REST_S, STEPS_MRAD, Curves, Tracking, known_noise, tracking
from servod.lab.tracking.stepped import curves_of


def measure_on_daemon(
    socket: Path,
    config: AxisConfig,
    deployed: tuple[str, int],
    tell: Callable[[float], None],
    gains: GainSet | None = None,
) -> tuple[Tracking | None, list[str]]:
    """Figures of the set `deployed` (name, version), and what the daemon refused; None where it refused (19).

    `gains` is that set, where it is at hand: its design knows the encoder's noise. The axis is left enabled or not, as
    it was. Raises AnswerIsNo when another set runs or the axis drops out, BadInput when the daemon has another
    configuration than `config`, Unreachable when it does not answer any more.
    """
    with ControlClient(socket) as client:
        require_daemon_config(client, config)
        axis = DaemonAxis(client)
        _require_active(axis, deployed)
        with _enabled(axis):
            curves, refused = _recorded(axis, tell)
    if "paper" not in curves:
        return None, refused
    steps = {mrad: curves[f"{mrad:g}"] for mrad in STEPS_MRAD if f"{mrad:g}" in curves}
    count_rad = 2.0 * math.pi / config.encoder.counts_per_turn
    noise_rad = known_noise(gains, count_rad) if gains else None
    return tracking(curves["paper"], steps, count_rad, encoder_rms_rad=noise_rad), refused


@contextlib.contextmanager
def _enabled(axis: AxisClient) -> Iterator[None]:
    """The axis enabled for what is measured, and as it was behind it; stopped before anything else when that fails."""
    was_enabled = axis.status().enabled
    try:
        if not was_enabled:
            axis.enable()
            axis.wait(REST_S)
        yield
    except BaseException:
        axis.stop()
        raise
    finally:
        if not was_enabled:
            axis.disable()


def _recorded(axis: AxisClient, tell: Callable[[float], None]) -> tuple[dict[str, Curves], list[str]]:
    """Curves by motion, "paper" or a step's size in mrad, and the motions that the daemon refused with its reason."""
    motions = {"paper": ReferenceMotion.paper(PAPER_S)}
    motions |= {f"{mrad:g}": ReferenceMotion.step(1e-3 * mrad, HOLD_S) for mrad in STEPS_MRAD}
    curves: dict[str, Curves] = {}
    refused: list[str] = []
    for index, (name, motion) in enumerate(motions.items()):
        tell(index / len(motions))
        start_rad = axis.status().reference_rad
        try:
            curves[name] = curves_of(axis.run(motion), start_rad)
        except (
            Refused,
            RemoteBadInput,
        ) as error:  # of an enabled axis: the motion is too much for its limits
            refused.append(f"{name}: {error}")
    return curves, refused


def _require_active(axis: AxisClient, deployed: tuple[str, int]) -> None:
    """What is measured is what was deployed. Raises AnswerIsNo."""
    if axis.active == deployed:
        return
    (runs, runs_version), (name, version) = axis.active, deployed
    raise AnswerIsNo(
        f"the axis runs {runs} version {runs_version}, but {name} version {version} was deployed; to measure that, "
        f"`servoctl gains activate {name} --version {version}`"
    )
