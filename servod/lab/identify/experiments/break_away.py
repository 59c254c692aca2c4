"""Break-away: the torque at which the joint begins to slide, in each direction.

Reason: it sets the scale of every later experiment, and static friction. Amplitude: an exponential ramp finds it from
nothing, within the torque bound; linear ramps then measure it. Bounds: the torque fades out as soon as the joint has
left a window of about a milliradian; no feedback acts, so a wrong polarity cannot run away, and is found here (wiring).
"""

from __future__ import annotations

import numpy as np

from servod.common.errors import AnswerIsNo
from servod.lab.identify.experiments import wiring
from servod.lab.identify.experiments.common import Bench, ExperimentEnded
from servod.lab.identify.fits.break_away import torque_of
from servod.lab.identify.shapes import growing, samples
from servod.lab.identify.trace import Kind, Trace

#: The search begins at this share of the allowed torque.
FIRST_SHARE = 0.003
SEARCH_S = 4.0
RAMP_S = 1.0
REST_S = 0.1
#: Linear ramps run between these shares of the torque that the search found.
RAMP_FROM, RAMP_TO = 0.5, 1.4
#: The joint has broken away beyond this, or this many counts.
WINDOW_RAD, WINDOW_COUNTS = 1.2e-3, 25.0


def search(bench: Bench, direction: float) -> Trace:
    """The exponential ramp. Raises AnswerIsNo when nothing moves, or when signs or scales of the wiring are wrong."""
    ramp = direction * growing(FIRST_SHARE * bench.bounds.torque_nm, bench.bounds.torque_nm, SEARCH_S, bench.period_s)
    config, moved_rad = bench.axis.config, 0.5 * window_rad(bench)
    try:
        trace = _ramp(bench, ramp, direction, True)
    except ExperimentEnded as ended:
        if ended.trace is not None:
            wiring.check_motion(ended.trace, config, moved_rad)
        raise
    wiring.check_motion(trace, config, moved_rad)
    if not np.isfinite(torque_of(trace)):
        raise AnswerIsNo(
            f"the joint did not move under {bench.bounds.torque_nm:.3g} N*m; is it blocked or braked, is "
            "limits.torque_nm too small for its friction, or is the scale of the torque wrong (0x6076, gear_ratio)?"
        )
    wiring.check_torque(torque_of(trace), bench.bounds.torque_nm, config.limits.torque_nm)
    return trace


def measure(bench: Bench, direction: float, found_nm: float) -> Trace:
    """A linear ramp around `found_nm`, the magnitude that the search found in this direction."""
    top = min(RAMP_TO * found_nm, bench.bounds.torque_nm)
    lead = direction * RAMP_FROM * found_nm * np.linspace(0.0, 1.0, samples(REST_S, bench.period_s))
    ramp = direction * np.linspace(RAMP_FROM * found_nm, top, samples(RAMP_S, bench.period_s))
    return _ramp(bench, np.concatenate([lead, ramp]), direction, False)


def window_rad(bench: Bench) -> float:
    """Distance at which the joint counts as broken away."""
    return max(WINDOW_RAD, WINDOW_COUNTS * bench.resolution_rad)


def _ramp(bench: Bench, ramp: np.ndarray[tuple[int], np.dtype[np.float64]], direction: float, search: bool) -> Trace:
    """Take the present position as reference, then ramp."""
    bench.set_gains(0.0, 0.0)
    window = window_rad(bench)
    settings = {"direction": direction, "window_rad": window, "search": float(search)}
    return bench.run(Kind.BREAK_AWAY, np.zeros(len(ramp)), ramp, window, settings)
