"""What the effects draw their start values from: the motion, and what the present fit leaves of the torque.

Stands between the fit of the moment and the effects' files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.hypothesis import Document, get
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

#: Two columns for an order n from sin(n*x) and cos(n*x), on the thinned rows of a scene.
Columns = Callable[[float, Array, Array], tuple[Array, Array]]

#: Periods that must lie within the range of positions before a periodic effect may be named.
LEAST_PERIODS = 1.5

#: Share of a period that must lie within the range when its order is given by the turn.
LEAST_OF_PERIOD = 0.8

#: Periods within the range, or in a radian turned (a metre), up to which a period is searched.
MOST_PERIODS, MOST_IN_TURN = 100.0, 130.0

#: Orders tried, at most; beyond them the grid gets coarse in vain.
MOST_ORDERS = 2500

#: Rows that searches work on, about; the mismatch is a low-passed signal and loses nothing.
SEARCH_ROWS = 6000


@dataclass(frozen=True)
class Peak:
    """A period found in the mismatch: n of sin(n*x), coefficients of sine and cosine, and the share it takes."""

    n: float
    sine: float
    cosine: float
    share: float


@dataclass(frozen=True)
class SearchContext:
    """The nominal document, the predictor with its traces, and the mismatch of the fit that stands now (N*m).

    `fine` asks for finer forms too, with more unknowns than a first look may spend; `present` is the document of that
    fit, for what acts on something that the nominal model does not have.
    """

    document: Document
    predictor: Predictor
    mismatch: Array
    fine: bool = False
    present: Document = field(default_factory=dict)

    @property
    def linear(self) -> bool:
        """Whether the axis moves in metres."""
        return self.document.get("axis") == "linear"

    @property
    def servo(self) -> bool:
        """Whether the torque is what a servo makes of its goal, by the drive of the model."""
        driven = any(trace.drive.told is not None for trace in self.predictor.traces)
        return driven and self.document["drive"]["kind"] in {"position_servo", "velocity"}

    @cached_property
    def servo_gain(self) -> float:
        """What the servo's loop makes of an error by the model or the recording, before `gain_scale`, 1/rad."""
        gains = [trace.drive.told.gain for trace in self.predictor.traces if trace.drive.told is not None]
        return get(self.document, "drive.kp", float(np.median(np.concatenate(gains))))

    @property
    def force(self) -> str:
        """Unit of torque."""
        return "N" if self.linear else "N·m"

    @property
    def length(self) -> str:
        """Unit of position."""
        return "m" if self.linear else "rad"

    @property
    def dry(self) -> float:
        """Dry friction of the nominal model, the scale of torques."""
        return self.predictor.dry

    @property
    def inertia(self) -> float:
        """Nominal inertia."""
        return get(self.document, "inertia")

    @property
    def viscous(self) -> float:
        """Nominal viscous friction; never nothing."""
        return max(get(self.document, "friction.viscous"), 0.02 * self.dry / self.speed)

    @cached_property
    def position(self) -> Array:
        """Positions of all rows."""
        return self.predictor.over("position")

    @cached_property
    def velocity(self) -> Array:
        """Velocities of all rows."""
        return self.predictor.over("velocity")

    @cached_property
    def acceleration(self) -> Array:
        """Accelerations of all rows."""
        return self.predictor.over("acceleration")

    @cached_property
    def torque(self) -> Array:
        """Commands of all rows."""
        return self.predictor.over("torque")

    @cached_property
    def time_s(self) -> Array:
        """Time stamps of all rows."""
        return self.predictor.over("t_s")

    @cached_property
    def speed(self) -> float:
        """A high speed of these recordings: 98 % of the rows are slower."""
        return max(float(np.quantile(np.abs(self.velocity), 0.98)), 1e-9)

    @cached_property
    def effort(self) -> float:
        """A high command of these recordings."""
        return max(float(np.quantile(np.abs(self.torque), 0.995)), 1e-9)

    @cached_property
    def reach(self) -> float:
        """Range of positions."""
        return max(float(np.ptp(self.position)), 1e-9)

    @cached_property
    def duration_s(self) -> float:
        """Length of the longest recording."""
        return max(trace.duration_s for trace in self.predictor.traces)

    @property
    def warm(self) -> bool:
        """Whether every recording has a temperature that changes."""
        return all(trace.has_temperature for trace in self.predictor.traces)

    def seen(self, torque: Array) -> Array:
        """A torque of every row as the observer would show it (its low-pass), N*m."""
        return np.concatenate(
            [
                observed(torque[part], self.predictor.rate, trace.period_s)
                for part, trace in zip(self.predictor.slices, self.predictor.traces, strict=True)
            ]
        )

    def fitted(self, columns: list[Array]) -> tuple[Array, float]:
        """Least squares of the mismatch on torques as the observer shows them: coefficients, share taken."""
        rows = self.predictor.counts
        design = np.column_stack([self.seen(column)[rows] for column in columns])
        wanted = self.mismatch[rows]
        found, *_ = np.linalg.lstsq(design, wanted, rcond=None)
        left = wanted - design @ found
        return found, 1.0 - float(left @ left) / max(float(wanted @ wanted), 1e-30)

    @cached_property
    def orders(self) -> Array:
        """Wave numbers n to search, from LEAST_PERIODS in the range up to what the observer resolves, 1/rad or 1/m."""
        lowest = 2.0 * math.pi * LEAST_PERIODS / self.reach
        slow = float(np.quantile(np.abs(self.velocity), 0.3))
        highest = min(
            self.predictor.rate * 3.0 / max(slow, 1e-9), max(2.0 * math.pi * MOST_PERIODS / self.reach, MOST_IN_TURN)
        )
        step = max(0.25 * 2.0 * math.pi / self.reach, (highest - lowest) / MOST_ORDERS)
        return np.arange(lowest, max(highest, 1.5 * lowest), step)

    def low_orders(self, *orders: float) -> list[float]:
        """Those of some orders per turn that go through most of a period within the range: less is no wave."""
        return [n for n in orders if n * self.reach >= 2.0 * math.pi * LEAST_OF_PERIOD]

    @cached_property
    def thinned(self) -> NDArray[np.int64]:
        """Rows that searches work on."""
        rows = np.flatnonzero(self.predictor.counts)
        return rows[:: max(1, len(rows) // SEARCH_ROWS)]

    def peaks(self, columns: Columns, count: int) -> list[Peak]:
        """The `count` strongest orders, by least squares of the mismatch on the two `columns` of each order."""
        wanted = self.mismatch[self.thinned]
        total = max(float(wanted @ wanted), 1e-30)
        found = [_peak(n, *pair, wanted, total) for n, pair in self.pairs(columns, self.orders)]
        return strongest(found, count, 2.0 * math.pi / self.reach)

    def pairs(self, columns: Columns, orders: Array) -> Iterator[tuple[float, tuple[Array, Array]]]:
        """The two columns of each of some evenly spaced orders.

        exp(i*n*x), x as the observer shows it, is turned on from order to order: a product costs a tenth of a sine and
        a cosine.
        """
        position = self.lagged_position[self.thinned]
        wave = np.exp(1j * orders[0] * position)
        turn = np.exp(1j * (orders[-1] - orders[0]) / max(len(orders) - 1, 1) * position)
        for n in orders:
            yield float(n), columns(float(n), wave.imag, wave.real)
            wave = wave * turn

    def carried(self, carrier: Array) -> Columns:
        """Columns of carrier*sin(n*x) and carrier*cos(n*x) as the observer shows them."""
        seen, fading = carrier[self.thinned], self.fading[self.thinned]

        def columns(n: float, sine: Array, cosine: Array) -> tuple[Array, Array]:
            gain = seen / (1.0 + (n * fading) ** 2)
            return gain * sine, gain * cosine

        return columns

    @cached_property
    def lagged_position(self) -> Array:
        """Position at the time at which the observer shows its torque: its low-pass delays by 2*damping/rate."""
        late = 2.0 * SETTINGS.observer.poles_damping / self.predictor.rate
        return self.position - late * self.velocity

    @cached_property
    def fading(self) -> Array:
        """Speed over the observer's bandwidth, by which a sine of order n is weaker: 1/(1 + (n*fading)^2)."""
        return np.abs(self.velocity) / self.predictor.rate


def _peak(n: float, sine: Array, cosine: Array, wanted: Array, total: float) -> Peak:
    sines, both, cosines = float(sine @ sine), float(sine @ cosine), float(cosine @ cosine)
    to_sine, to_cosine = float(sine @ wanted), float(cosine @ wanted)
    ridge = 1e-9 * (sines + cosines) + 1e-30
    determinant = (sines + ridge) * (cosines + ridge) - both * both
    of_sine = (to_sine * (cosines + ridge) - to_cosine * both) / determinant
    of_cosine = (to_cosine * (sines + ridge) - to_sine * both) / determinant
    return Peak(n, of_sine, of_cosine, (of_sine * to_sine + of_cosine * to_cosine) / total)


def strongest(peaks: list[Peak], count: int, apart: float) -> list[Peak]:
    """The `count` strongest peaks that are at least `apart` from each other."""
    kept: list[Peak] = []
    for peak in sorted(peaks, key=lambda p: -p.share):
        if all(abs(peak.n - other.n) >= apart for other in kept):
            kept.append(peak)
        if len(kept) == count:
            break
    return kept


def observed(torque: Array, rate: float, period_s: float) -> Array:
    """A torque through the observer: second-order low-pass of its poles, exact for one held over each row."""
    from scipy.signal import lfilter

    decay = math.exp(-SETTINGS.observer.poles_damping * rate * period_s)
    turn = math.cos(rate * period_s * math.sqrt(1.0 - SETTINGS.observer.poles_damping**2))
    poles = [1.0, -2.0 * decay * turn, decay**2]
    gain = sum(poles)
    return np.asarray(lfilter([0.0, 0.5 * gain, 0.5 * gain], poles, torque))
