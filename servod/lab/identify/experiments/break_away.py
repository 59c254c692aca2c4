"""Break-away: the torque at which the joint begins to slide, in each direction.

Reason: it sets the scale of every later experiment, and static friction. Amplitude: an exponential ramp finds it from
nothing, within the torque bound; linear ramps then measure it. Bounds: the torque fades out as soon as the joint has
left a window of about a milliradian; no feedback acts, so a wrong polarity cannot run away, and is found here (wiring).
"""

from __future__ import annotations

import numpy as np

from servod.common.errors import AnswerIsNo
from servod.common.units import TWO_PI
from servod.formats.config import AxisConfig
from servod.lab.identify.experiments.common import Bench, ExperimentEnded
from servod.lab.identify.fits.break_away import torque_of
from servod.lab.identify.shapes import growing, samples
from servod.lab.identify.trace import ExperimentKind, RecordedMotion

# --- The wiring ------------------------------------------------------------------------------------------------------
# What the first motion says of the wiring: sign and scale of torque and of both position sensors. Behind the first
# ramp, which moves the joint by about a milliradian under no feedback; nothing else runs before it. What is wrong is
# told with the key to turn round, so that no position loop is ever closed over a wrong sign.


#: The two sensors' ways may differ by this factor (slack, elasticity) and by so many counts of the coarser one.
MOST_RATIO, COUNTS = 2.0, 3.0
#: So far apart over the whole way and over its second half as well, when slack is taken up and a spring is wound: a
#: wrong scale shows in both alike, slack in the first half, and a spring unwinds in the second.
STEADY_RATIO = 1.5
#: A joint that moves at less than this share of the torque limit: scale or limit is wrong.
LEAST_TORQUE_SHARE = 0.04


def check_motion(ramp: RecordedMotion, config: AxisConfig, moved_rad: float) -> None:
    """Raise AnswerIsNo, naming the key, when the sensors' ways do not fit the torque or each other.

    `moved_rad`: what counts as a motion. A ramp under which neither sensor saw one says nothing here.
    """
    sign = ramp.settings["direction"]
    encoder = sign * float(ramp.position_rad[-1] - ramp.position_rad[0])
    motor = sign * float(ramp.motor_rad[-1] - ramp.motor_rad[0])
    if max(abs(encoder), abs(motor)) < moved_rad:
        return
    _check_scale((abs(encoder), abs(motor)), _second_half(ramp), config)
    _check_signs(encoder, motor)


def check_torque(found_nm: float, allowed_nm: float, limit_nm: float) -> None:
    """Raise AnswerIsNo when break-away is so small a part of what is allowed that the torque's scale must be wrong."""
    if abs(found_nm) < LEAST_TORQUE_SHARE * allowed_nm:
        raise AnswerIsNo(
            f"the joint moves at {abs(found_nm):.3g} N*m already, {100.0 * abs(found_nm) / limit_nm:.2g} % of "
            "limits.torque_nm: the scale of the torque is wrong (compare 0x6076 with the data sheet, state "
            "amplifier.rated_torque_mnm, check amplifier.quirks), or, if it is right, limits.torque_nm is far too "
            f"large for this joint; set it to {10.0 * abs(found_nm):.2g} N*m"
        )


def _second_half(ramp: RecordedMotion) -> tuple[float, float]:
    """Ways of encoder and amplifier's sensor from where the one that moves further has half of its way behind it."""
    ways = [np.abs(sensor - sensor[0]) for sensor in (ramp.position_rad, ramp.motor_rad)]
    further = max(ways, key=lambda way: float(way[-1]))
    half = int(np.argmax(further >= 0.5 * further[-1]))
    encoder, motor = (abs(float(way[-1] - way[half])) for way in ways)
    return encoder, motor


def _check_scale(whole: tuple[float, float], late: tuple[float, float], config: AxisConfig) -> None:
    """Magnitudes of both ways, encoder's and amplifier's, against each other: of the whole, and of its second half."""
    (encoder, motor), amplifier = whole, config.amplifier
    count_rad = TWO_PI / min(amplifier.counts_per_turn * amplifier.gear_ratio, float(config.encoder.counts_per_turn))
    small, large = min(encoder, motor), max(encoder, motor)
    longer = {_apart(ways, STEADY_RATIO, count_rad) for ways in (whole, late)}
    if longer not in ({1}, {-1}) and not _apart(whole, MOST_RATIO, count_rad):
        return
    first, second = ("amplifier's", "encoder's") if motor > encoder else ("encoder's", "amplifier's")
    if small < count_rad:
        raise AnswerIsNo(
            f"the {first} sensor moved by {1e3 * large:.2g} mrad, the {second} stood still: check its coupling and "
            "cable, and counts_per_turn of both"
        )
    raise AnswerIsNo(
        f"the {first} sensor moved {large / small:.2g} times as far as the {second}: wrong scale; check "
        "encoder.counts_per_turn, amplifier.counts_per_turn and amplifier.gear_ratio against the data sheets"
    )


def _apart(ways: tuple[float, float], ratio: float, count_rad: float) -> int:
    """Which of two ways is the longer by more than `ratio` and some counts: 1 the first, -1 the second, 0 neither."""
    first, second = ways
    if max(ways) <= ratio * min(ways) + COUNTS * count_rad:
        return 0
    return 1 if first > second else -1


def _check_signs(encoder: float, motor: float) -> None:
    """Signs of both ways against the torque's."""
    if encoder < 0.0 and motor < 0.0:
        raise AnswerIsNo(
            "positive torque moves the joint backwards by both sensors: wrong polarity of the torque; turn round "
            "amplifier.torque_direction (or the drive's 0x607E)"
        )
    if encoder < 0.0:
        raise AnswerIsNo(
            "positive torque moves the encoder backwards, and the amplifier's sensor forwards: wrong polarity of the "
            "encoder; turn round encoder.direction"
        )
    if motor < 0.0:
        raise AnswerIsNo(
            "positive torque moves the amplifier's sensor backwards, and the encoder forwards: wrong polarity of the "
            "amplifier's position; turn round amplifier.position_direction"
        )


#: The search begins at this share of the allowed torque.
FIRST_SHARE = 0.003
SEARCH_S = 4.0
RAMP_S = 1.0
REST_S = 0.1
#: Linear ramps run between these shares of the torque that the search found.
RAMP_FROM, RAMP_TO = 0.5, 1.4
#: The joint has broken away beyond this, or this many counts.
WINDOW_RAD, WINDOW_COUNTS = 1.2e-3, 25.0


def search(bench: Bench, direction: float) -> RecordedMotion:
    """The exponential ramp. Raises AnswerIsNo when nothing moves, or when signs or scales of the wiring are wrong."""
    ramp = direction * growing(FIRST_SHARE * bench.bounds.torque_nm, bench.bounds.torque_nm, SEARCH_S, bench.period_s)
    config, moved_rad = bench.axis.config, 0.5 * window_rad(bench)
    try:
        trace = _ramp(bench, ramp, direction, True)
    except ExperimentEnded as ended:
        if ended.trace is not None:
            check_motion(ended.trace, config, moved_rad)
        raise
    check_motion(trace, config, moved_rad)
    if not np.isfinite(torque_of(trace)):
        raise AnswerIsNo(
            f"the joint did not move under {bench.bounds.torque_nm:.3g} N*m; is it blocked or braked, is "
            "limits.torque_nm too small for its friction, or is the scale of the torque wrong (0x6076, gear_ratio)?"
        )
    check_torque(torque_of(trace), bench.bounds.torque_nm, config.limits.torque_nm)
    return trace


def measure(bench: Bench, direction: float, found_nm: float) -> RecordedMotion:
    """A linear ramp around `found_nm`, the magnitude that the search found in this direction."""
    top = min(RAMP_TO * found_nm, bench.bounds.torque_nm)
    lead = direction * RAMP_FROM * found_nm * np.linspace(0.0, 1.0, samples(REST_S, bench.period_s))
    ramp = direction * np.linspace(RAMP_FROM * found_nm, top, samples(RAMP_S, bench.period_s))
    return _ramp(bench, np.concatenate([lead, ramp]), direction, False)


def window_rad(bench: Bench) -> float:
    """Distance at which the joint counts as broken away."""
    return max(WINDOW_RAD, WINDOW_COUNTS * bench.resolution_rad)


def _ramp(
    bench: Bench, ramp: np.ndarray[tuple[int], np.dtype[np.float64]], direction: float, search: bool
) -> RecordedMotion:
    """Take the present position as reference, then ramp."""
    bench.set_gains(0.0, 0.0)
    window = window_rad(bench)
    settings = {"direction": direction, "window_rad": window, "search": float(search)}
    return bench.run(ExperimentKind.BREAK_AWAY, np.zeros(len(ramp)), ramp, window, settings)
