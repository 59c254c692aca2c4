"""Torque that repeats with position, beside any linear model: which periods, found one at a time.

Under the friction map, which fits amplitude and phase jointly with friction once the periods are known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Periods per turn that are looked for.
HIGHEST_ORDER = 150
MOST_ORDERS = 6
#: An order must show at least this share of a period in the travel.
LEAST_PERIODS = 0.75
#: Gravity is the order that is looked for on less than that, from this travel on.
GRAVITY, GRAVITY_TRAVEL_RAD = 1, 1.0
#: It must take at least this share off the variance that is left, and this many times its own expectation.
LEAST_SHARE, LEAST_RATIO = 0.02, 12.0


def columns(position: Array, orders: list[int], smear: Array | float = 0.0) -> Array:
    """sin and cos of every order, side by side; a torque smoothed over `smear` (Gaussian, rad) shows less of them."""
    seen = [np.exp(-0.5 * (order * np.asarray(smear)) ** 2) for order in orders]
    waves = [s * wave(order * position) for order, s in zip(orders, seen, strict=True) for wave in (np.sin, np.cos)]
    stacked: Array = np.column_stack(waves) if waves else np.zeros((len(position), 0))
    return stacked


def find_orders(base: Array, position: Array, torque: Array, parts: int) -> list[int]:
    """Orders whose sine explains what `base` leaves of `torque`; `parts`: number of independent pieces of data."""
    lowest = max(1, int(np.ceil(LEAST_PERIODS * 2.0 * np.pi / float(np.ptp(position)))))
    candidates = list(range(lowest, HIGHEST_ORDER + 1))
    if lowest > GRAVITY and float(np.ptp(position)) > GRAVITY_TRAVEL_RAD:
        candidates.insert(0, GRAVITY)
    orders: list[int] = []
    while len(orders) < MOST_ORDERS:
        basis, _ = np.linalg.qr(np.column_stack([base, columns(position, orders)]))
        left = torque - basis @ (basis.T @ torque)
        gains = np.array([_explained(basis, left, position, order) for order in candidates])
        best = int(np.argmax(gains))
        share = float(gains[best] / (left @ left))
        if share < LEAST_SHARE or share * parts / 2.0 < LEAST_RATIO or candidates[best] in orders:
            break
        orders.append(candidates[best])
    return orders


def _explained(basis: Array, left: Array, position: Array, order: int) -> float:
    """Sum of squares that one order takes off `left`, beside the basis."""
    wave = columns(position, [order])
    wave = wave - basis @ (basis.T @ wave)
    gram = wave.T @ wave
    if np.linalg.det(gram) < 1e-9 * gram[0, 0] * gram[1, 1]:
        return 0.0
    projection = wave.T @ left
    return float(projection @ np.linalg.solve(gram, projection))
