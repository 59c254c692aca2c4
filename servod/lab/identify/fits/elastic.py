"""Two masses with a spring between them: sampled response of the motor's side, and the fit of its resonance.

Beside the rigid joint of the response fit; taken only where the rigid joint does not explain the response.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import least_squares

from servod.lab.identify.estimate import bound_notes

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: No resonance is looked for below: there the sliding joint is disturbed by what repeats with position.
LOWEST_HZ = 12.0
#: Where the search for the resonance begins, as shares of the lines' range (logarithmic), and shares of the load.
_STARTS, _LOADS = (0.3, 0.5, 0.65, 0.8, 0.9, 1.0), (0.25, 0.6)
#: Ranges: share of the inertia behind the spring, damping ratio of the resonance.
_LOAD, _DAMPING = (0.02, 0.95), (1e-3, 0.7)
#: Halvings of the interval in which the longest lag lies.
LAG_STEPS = 5
#: Longest delay that is looked for, s.
LONGEST_DELAY_S = 0.05


class Elastic(NamedTuple):
    """Inertia of both masses kg*m^2, viscous friction of the motor's side, delay s, and the spring between them.

    `resonance_hz` is that of both masses against each other, `load_share` the load's part of the inertia.
    """

    inertia: float
    viscous: float
    delay_s: float
    resonance_hz: float
    load_share: float
    damping_ratio: float

    @property
    def load_inertia(self) -> float:
        """The part of the inertia behind the spring."""
        return self.inertia * self.load_share

    @property
    def stiffness(self) -> float:
        """N*m/rad of the spring."""
        reduced = self.inertia * self.load_share * (1.0 - self.load_share)
        return (2.0 * math.pi * self.resonance_hz) ** 2 * reduced

    @property
    def damping(self) -> float:
        """N*m*s/rad of the spring."""
        reduced = self.inertia * self.load_share * (1.0 - self.load_share)
        return 2.0 * self.damping_ratio * 2.0 * math.pi * self.resonance_hz * reduced


class Notes(NamedTuple):
    """A note for each number of `Elastic`, empty where it was found within its range."""

    inertia: str
    viscous: str
    delay_s: str
    resonance_hz: str
    load_share: str
    damping_ratio: str


def response_of(joint: Elastic, frequency_hz: Array, period_s: float) -> Complex:
    """Way of the motor's side in a period over the command of sample k, held and delayed, at each frequency."""
    motor, load = joint.inertia - joint.load_inertia, joint.load_inertia
    k, d = joint.stiffness, joint.damping
    a = np.zeros((4, 4))
    a[0, 1] = a[2, 3] = 1.0
    a[1] = [-k / motor, -(d + joint.viscous) / motor, k / motor, d / motor]
    a[3] = [k / load, d / load, -k / load, -d / load]
    b = np.array([0.0, 1.0 / motor, 0.0, 0.0])
    whole = math.floor(joint.delay_s / period_s)
    part = joint.delay_s - whole * period_s
    step, late = _held(a, b, period_s), _held(a, b, period_s - part)
    # of the period that a command is held for, the first `part` still belongs to the command before
    z = np.exp(2j * np.pi * frequency_hz * period_s)
    new, old = late[1], step[1] - late[1]
    drive = new[None, :] + old[None, :] / z[:, None]
    state = np.linalg.solve(z[:, None, None] * np.eye(4) - step[0], drive[:, :, None])[:, 0, 0]
    response: Complex = state * (z - 1.0) * z ** (-whole)
    return response


def solve(frequency: Array, ratio: Complex, deviation: Array, period_s: float, inertia: float) -> Elastic:
    """The two masses that fit the measured `ratio` best, relative to its `deviation`."""
    band = np.log([LOWEST_HZ, frequency[-1]])
    found = [
        _from(frequency, ratio, deviation, period_s, np.array([np.log(inertia), 50.0, 1.5, log_hz, load, 0.03]))
        for log_hz in band[0] + np.array(_STARTS) * (band[1] - band[0])
        for load in _LOADS
    ]
    return min(found, key=lambda each: each[1])[0]


def solve_from(first: Elastic, frequency: Array, ratio: Complex, deviation: Array, period_s: float) -> Elastic:
    """The same, beginning at a solution that is nearly right."""
    return _from(frequency, ratio, deviation, period_s, _values(first))[0]


def longest_lag_s(
    first: Elastic, frequency: Array, ratio: Complex, deviation: Array, period_s: float, longest_s: float, worse: float
) -> float:
    """Longest lag [s], at most `longest_s`, with which two masses fit no worse than by the factor `worse`.

    All numbers are fitted again behind each lag (profile likelihood); by bisection, since longer ones fit worse.
    """

    def cost(lag_s: float) -> float:
        behind = ratio * (1.0 + 2j * np.pi * frequency * lag_s)
        values = _values(first)
        values[2] = max(values[2] - 1e3 * lag_s, 0.0)
        return _from(frequency, behind, deviation, period_s, values)[1]

    most = worse * cost(0.0)
    if cost(longest_s) <= most:
        return longest_s
    good, bad = 0.0, longest_s
    for _ in range(LAG_STEPS):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if cost(middle) <= most else (good, middle)
    return bad


def notes(joint: Elastic, inertia: float, highest_hz: float) -> Notes:
    """What stands at the end of the range that was searched from `inertia` and over lines up to `highest_hz`."""
    return Notes(*bound_notes(_values(joint).tolist(), *_ranges(math.log(inertia), highest_hz)))


def _from(frequency: Array, ratio: Complex, deviation: Array, period_s: float, x: Array) -> tuple[Elastic, float]:
    def misfit(values: Array) -> Array:
        error = (response_of(_joint(values), frequency, period_s) / ratio - 1.0) / deviation
        return np.concatenate([error.real, error.imag])

    low, high = _ranges(float(x[0]), float(frequency[-1]))
    found = least_squares(misfit, np.clip(x, low, high), bounds=(low, high), loss="soft_l1", x_scale="jac", max_nfev=60)
    return _joint(found.x), float(np.sum(found.fun**2))


def _ranges(log_inertia: float, highest_hz: float) -> tuple[list[float], list[float]]:
    """Lower and upper bounds of the search's values, about a first idea of inertia."""
    low = [log_inertia - 3.0, -2000.0, 0.0, math.log(LOWEST_HZ), _LOAD[0], _DAMPING[0]]
    high = [log_inertia + 3.0, 1e4, 1e3 * LONGEST_DELAY_S, math.log(2.0 * highest_hz), _LOAD[1], _DAMPING[1]]
    return low, high


def _values(joint: Elastic) -> Array:
    """What the search varies."""
    x: Array = np.array([
        np.log(joint.inertia), joint.viscous / joint.inertia, 1e3 * joint.delay_s, np.log(joint.resonance_hz),
        joint.load_share, joint.damping_ratio,
    ])  # fmt: skip
    return x


def _joint(x: Array) -> Elastic:
    inertia = float(np.exp(x[0]))
    return Elastic(inertia, float(x[1]) * inertia, 1e-3 * float(x[2]), float(np.exp(x[3])), float(x[4]), float(x[5]))


def _held(a: Array, b: Array, duration_s: float) -> tuple[Array, Array]:
    """State transition over `duration_s`, and what an input held over it adds (Van Loan's block exponential)."""
    block = np.zeros((5, 5))
    block[:4, :4], block[:4, 4] = a, b
    both = expm(block * duration_s)
    return both[:4, :4], both[:4, 4]
