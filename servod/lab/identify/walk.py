"""The whole identification on an axis: experiments in order, each setting the scale of the next.

Above experiments and fits. The axis is switched off however the walk ends, Ctrl-C included.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servod.client.axis import AxisClient
from servod.common.errors import ServodError
from servod.common.progress import OnProgress
from servod.formats.config import AxisConfig
from servod.formats.model.identified import Devices
from servod.lab.identify import store
from servod.lab.identify.analysis import Analysis, analyse, break_away_rad, of_kind
from servod.lab.identify.bounds import CAREFUL, STIFF, bounds_from, feedback
from servod.lab.identify.experiments import break_away, friction_map, kick, presliding, response
from servod.lab.identify.experiments.common import Bench, enable_powerless
from servod.lab.identify.fits import break_away as break_away_fit
from servod.lab.identify.fits import kick as kick_fit
from servod.lab.identify.fits import presliding as presliding_fit
from servod.lab.identify.fits import response as response_fit
from servod.lab.identify.trace import ExperimentKind, RecordedMotion

#: Ramps and bursts of presliding, in pairs of both directions.
PAIRS = 5

#: What the first idea of the delay may lack, in s.
UNKNOWN_DELAY_S = 1e-3


def identify(
    axis: AxisClient,
    out: Path,
    on_progress: OnProgress,
    *,
    travel_rad: float | None = None,
    speed_rad_s: float | None = None,
    seed: int = 1,
    resume: bool = False,
    subject: str = "",
) -> Analysis:
    """Run every experiment, keep the recordings in the folder `out`, and fit them all.

    `travel_rad` (to each side) and `speed_rad_s` narrow what the limits allow. `resume`: experiments that `out` holds
    already are not run again, as long as configuration and options are the same, and `subject`, a name or hash of what
    is identified, too; what is not taken up again the first new recording sets aside within `out`. Raises AnswerIsNo
    when the axis refuses, faults, is wired wrongly, or tells nothing.
    """
    devices = axis.devices
    conditions = _conditions(axis.config, devices, travel_rad, speed_rad_s, seed, subject)
    recordings = store.Recordings(out, conditions, resume, axis.offset_ns)
    taken_up = recordings.start_rad is not None
    try:
        start_rad = enable_powerless(axis) if recordings.start_rad is None else recordings.start_rad
        recordings.begin(start_rad, devices)
        bounds = bounds_from(axis.config.limits, start_rad, travel_rad, speed_rad_s)
        rng = np.random.default_rng(seed)
        bench = Bench(axis, bounds, recordings, rng, start_rad=start_rad, enabled=not taken_up)
        _experiments(bench, on_progress)
    finally:
        axis.disable()
        with contextlib.suppress(ServodError):  # a daemon that is gone, or no experiment was run
            axis.give_up("the feedback of experiments, which are over", {})
    on_progress("fits", 0.97)
    return analyse(bench.traces, recordings.devices)


def _conditions(
    config: AxisConfig, devices: Devices, travel_rad: float | None, speed_rad_s: float | None, seed: int, subject: str
) -> str:
    """Hash of all that recordings of one walk must share; paths and services of the configuration do not count."""
    parts = config.model_dump(mode="json", include={"cycle", "amplifier", "encoder", "limits"})
    known = [devices.model_dump()] if devices != Devices() else []
    asked = json.dumps([parts, *known, travel_rad, speed_rad_s, seed, subject], sort_keys=True)
    return hashlib.sha256(asked.encode()).hexdigest()


def _experiments(bench: Bench, on_progress: OnProgress) -> None:
    on_progress("noise at rest", 0.0)
    kick.run_noise(bench)
    on_progress("break-away", 0.02)
    found = [abs(break_away_fit.torque_of(break_away.search(bench, sign))) for sign in (1.0, -1.0)]
    on_progress("presliding", 0.07)
    _rock(bench, (found[0], found[1]))
    slides = break_away_fit.fit([ramp for ramp in bench.of(ExperimentKind.BREAK_AWAY) if not ramp.settings["search"]])
    rocked = presliding_fit.fit(of_kind(bench.traces, ExperimentKind.PRESLIDING), slides)
    on_progress("kicks", 0.2)
    first = kick_fit.fit(kick.run(bench, (found[0], found[1])))
    on_progress("frequency response", 0.25)
    config = bench.axis.config
    gains = feedback(config, first.inertia, first.delay_s + UNKNOWN_DELAY_S, CAREFUL)
    answer = response_fit.fit(response.run(bench, first.inertia, gains), first.inertia)
    on_progress("bristle damping", 0.38)
    presliding.run(bench, min(found))
    on_progress("friction map", 0.42)
    gains = feedback(config, answer.inertia.value, answer.delay_s.value + answer.lag_s.value, STIFF)
    friction_map.run(bench, gains, slides, break_away_rad(slides, rocked))
    bench.go_to(0.0, gains, 0.3 * bench.bounds.speed_rad_s)


def _rock(bench: Bench, found_nm: tuple[float, float]) -> None:
    """Bursts below break-away; the ramps between them measure it, and put the joint somewhere else."""
    weaker = min(found_nm)
    trial: RecordedMotion = presliding.burst(bench, weaker, presliding.SHARE)
    share = presliding.share_for(bench, _extent(trial.position_rad))
    for _ in range(PAIRS):
        for sign, torque in zip((1.0, -1.0), found_nm, strict=True):
            break_away.measure(bench, sign, torque)
            presliding.burst(bench, weaker, share)


def _extent(values: NDArray[np.float64]) -> float:
    return float(np.ptp(values))
