"""Weighting functions mu_i of the local sets (Fig. 2): a partition of unity over the velocity, in several shapes.

Stands under the `local` law. `blended` is what the law evaluates, `weights` the same functions one by one for
pictures and proofs. Outside the outermost nodes the weights are those of the outer node and the decay grows with |v|,
so that the friction stays at the level of the outer node instead of growing without bound.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum


class Shape(IntEnum):
    """Shape of the weighting functions; its number is packed into the law's parameters."""

    LINEAR = 0  # triangles: linear interpolation between neighbours
    COSINE = 1  # raised cosine between neighbours: no kink at the nodes
    GAUSSIAN = 2  # Gaussian bells, each side as wide as the gap to that neighbour, normalised to sum one


GAUSSIAN_WIDTH = 0.5  # standard width of a bell, as a share of the gap to the neighbour
COSINE = 1.0
GAUSSIAN = 2.0


def lower_node(p: Sequence[float], first: int, n: int, v: float) -> int:
    """Index k (0 to n-2) with p[first+k] <= v < p[first+k+1], clamped to the ends; the nodes ascend."""
    low, high = 0, n - 1
    while high - low > 1:
        middle = (low + high) >> 1
        if v < p[first + middle]:
            high = middle
        else:
            low = middle
    return low


def upper_share(shape: float, share: float) -> float:
    """Weight of the upper neighbour at `share` (0 to 1) of the way between two nodes, for linear and cosine shapes."""
    if shape == COSINE:
        return 0.5 - 0.5 * math.cos(math.pi * share)
    return share


def bell(p: Sequence[float], first: int, n: int, i: int, v: float) -> float:
    """Gaussian bell of set `i` at `v`, not normalised."""
    away = v - p[first + i]
    if away == 0.0:
        return 1.0
    neighbour = i + 1 if away > 0.0 else i - 1
    if neighbour < 0 or neighbour >= n:
        return 1.0
    width = GAUSSIAN_WIDTH * abs(p[first + neighbour] - p[first + i])
    return math.exp(-0.5 * (away / width) ** 2)


def blended_bells(p: Sequence[float], first: int, n: int, v: float) -> tuple[float, float]:
    """(a, l) blended by normalised Gaussian bells; `p` holds n nodes, n decays, n gains l from `first` on."""
    total, decay, gain = 0.0, 0.0, 0.0
    for i in range(n):
        weight = bell(p, first, n, i, v)
        total += weight
        decay += weight * p[first + n + i]
        gain += weight * p[first + 2 * n + i]
    return decay / total, gain / total


def blended(p: Sequence[float], first: int, n: int, shape: float, v: float) -> tuple[float, float]:
    """Decay a(v) [1/s] and gain l(v) of (9) at velocity `v` [rad/s]: sum of mu_i*a_i and of mu_i*l_i."""
    held = min(max(v, p[first]), p[first + n - 1])
    beyond = v / held if v != held else 1.0
    if shape == GAUSSIAN:
        decay, gain = blended_bells(p, first, n, held)
        return decay * beyond, gain
    k = first + lower_node(p, first, n, held)
    share = upper_share(shape, (held - p[k]) / (p[k + 1] - p[k]))
    decay = p[k + n] + share * (p[k + n + 1] - p[k + n])
    return decay * beyond, p[k + 2 * n] + share * (p[k + 2 * n + 1] - p[k + 2 * n])


def weights(shape: Shape, nodes_rad_s: Sequence[float], v: float) -> list[float]:
    """Weights mu_i at velocity `v` [rad/s] for ascending nodes (at least two); not negative, and their sum is one."""
    n = len(nodes_rad_s)
    held = min(max(v, nodes_rad_s[0]), nodes_rad_s[-1])
    if shape is Shape.GAUSSIAN:
        bells = [bell(nodes_rad_s, 0, n, i, held) for i in range(n)]
        return [b / sum(bells) for b in bells]
    k = lower_node(nodes_rad_s, 0, n, held)
    share = upper_share(float(shape), (held - nodes_rad_s[k]) / (nodes_rad_s[k + 1] - nodes_rad_s[k]))
    return [1.0 - share if i == k else share if i == k + 1 else 0.0 for i in range(n)]
