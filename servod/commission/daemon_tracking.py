"""The tracking comparison on an axis under a daemon: the deployed law alone, as far as the axis's limits allow.

Beside the step that validates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from servod.config import AxisConfig
from servod.control import ControlClient
from servod.deploy.daemon_link import DaemonDeployLink
from servod.errors import Unreachable
from servod.tracking.metrics import Curves, Tracking, tracking
from servod.tracking.motions import HOLD_S, PAPER_S, STEPS_MRAD
from servod.tracking.stepped import curves_of


def measure_on_daemon(
    socket: Path, config: AxisConfig, tell: Callable[[float], None]
) -> tuple[Tracking | None, list[str]]:
    """Figures of the set that runs, and what the daemon refused; None where it refused trajectory (19).

    The axis is left enabled or not, as it was. Raises AnswerIsNo when the axis drops out.
    """
    motions = {"paper": {"kind": "paper", "duration_s": PAPER_S}}
    motions |= {
        f"{mrad:g}": {"kind": "step", "amplitude_rad": 1e-3 * mrad, "duration_s": HOLD_S} for mrad in STEPS_MRAD
    }
    curves: dict[str, Curves] = {}
    refused: list[str] = []
    with ControlClient(socket) as client:
        link = DaemonDeployLink(client)
        was_enabled = link.enabled
        try:
            if not was_enabled:
                link.enable()
            for index, (name, motion) in enumerate(motions.items()):
                tell(index / len(motions))
                start_rad = float(client.call("status")["motion"]["reference_rad"])
                try:
                    curves[name] = curves_of(link.record([motion]).tobytes(), start_rad)
                except Unreachable as error:
                    refused.append(f"{name}: {error}")
        except BaseException:
            link.stop()
            raise
        finally:
            if not was_enabled:
                link.disable()
    if "paper" not in curves:
        return None, refused
    steps = {mrad: curves[f"{mrad:g}"] for mrad in STEPS_MRAD if f"{mrad:g}" in curves}
    return tracking(curves["paper"], steps, 2.0 * math.pi / config.encoder.counts_per_turn), refused
