"""Weighting functions mu_i of the local sets (Fig. 2): a partition of unity over the velocity, in several shapes.

Stands under the `local` law. `blended` is what the law evaluates, `weights` the same functions one by one for
pictures and proofs. Only the two neighbours of a velocity have weight there, whatever the shape: friction maps span
three decades of velocity, and the decay a_i of a fast set would drown the friction of the slow ones.

The decay is blended so that the compensated steady friction c0*|v|/a(v) runs between the values of both neighbours:
a(v) = v*(sum mu_i*a_i)/(sum mu_i*v_i). For the linear shape sum mu_i*v_i is v, which leaves the paper's sum mu_i*a_i.
Outside the outermost nodes the weights are those of the outer node and the decay grows with |v|, so that the friction
stays at the level of the outer node instead of growing without bound.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple


class Shape(IntEnum):
    """Shape of the weighting functions; its number is packed into the law's parameters."""

    LINEAR = 0  # triangles: linear interpolation between neighbours
    COSINE = 1  # raised cosine between neighbours: no kink at the nodes
    GAUSSIAN = 2  # Gaussian bells half as wide as the gap, lowered to end at the neighbour, normalised to sum one


COSINE = 1.0
GAUSSIAN = 2.0
GAUSSIAN_WIDTH = 0.5  # standard width of a bell, as a share of the gap to the neighbour
BELL_RATE = 0.5 / GAUSSIAN_WIDTH**2
BELL_END = math.exp(-BELL_RATE)  # what a whole bell would still have at the neighbour's node


class Sets(NamedTuple):
    """The local sets of (9), at least two, by ascending node."""

    nodes: Sequence[float]  # v_i [rad/s]
    decays: Sequence[float]  # a_i [1/s]
    gains: Sequence[float]  # l_i


def lower_node(nodes: Sequence[float], v: float) -> int:
    """Index k (0 to n-2) with nodes[k] <= v < nodes[k+1], clamped to the ends; the nodes ascend."""
    low, high = 0, len(nodes) - 1
    while high - low > 1:
        middle = (low + high) >> 1
        if v < nodes[middle]:
            high = middle
        else:
            low = middle
    return low


def upper_share(shape: float, share: float) -> float:
    """Weight of the upper neighbour at `share` (0 to 1) of the way between two nodes; the lower one has the rest."""
    if shape == COSINE:
        return 0.5 - 0.5 * math.cos(math.pi * share)
    if shape == GAUSSIAN:
        lower = math.exp(-BELL_RATE * share * share) - BELL_END
        upper = math.exp(-BELL_RATE * (1.0 - share) * (1.0 - share)) - BELL_END
        return upper / (lower + upper)
    return share


def blended(sets: Sets, shape: float, v: float) -> tuple[float, float]:
    """Decay a(v) [1/s] and gain l(v) of (9) at velocity `v` [rad/s]."""
    nodes, decays, gains = sets.nodes, sets.decays, sets.gains
    held = min(max(v, nodes[0]), nodes[len(nodes) - 1])
    beyond = v / held if v != held else 1.0
    k = lower_node(nodes, held)
    share = (held - nodes[k]) / (nodes[k + 1] - nodes[k])
    upper = upper_share(shape, share)
    decay = blended_decay(nodes[k], nodes[k + 1], decays[k], decays[k + 1], share, upper)
    return decay * beyond, gains[k] + upper * (gains[k + 1] - gains[k])


def blended_decay(low: float, high: float, a_low: float, a_high: float, share: float, upper: float) -> float:
    """Decay at `share` of the way from node `low` to `high`, the upper one having weight `upper`.

    A node at rest has no friction to interpolate: its decay fades by its weight, and the neighbour's friction holds
    down to standstill. Between nodes of both signs without one at rest the plain sum stays.
    """
    if low == 0.0:
        return (1.0 - upper) * a_low + share * a_high
    if high == 0.0:
        return (1.0 - share) * a_low + upper * a_high
    plain = a_low + upper * (a_high - a_low)
    if upper == share or low * high < 0.0:
        return plain
    return plain * (low + share * (high - low)) / (low + upper * (high - low))


def weights(shape: Shape, nodes_rad_s: Sequence[float], v: float) -> list[float]:
    """Weights mu_i at velocity `v` [rad/s] for ascending nodes (at least two); not negative, and their sum is one."""
    n = len(nodes_rad_s)
    held = min(max(v, nodes_rad_s[0]), nodes_rad_s[-1])
    k = lower_node(nodes_rad_s, held)
    upper = upper_share(float(shape), (held - nodes_rad_s[k]) / (nodes_rad_s[k + 1] - nodes_rad_s[k]))
    return [1.0 - upper if i == k else upper if i == k + 1 else 0.0 for i in range(n)]
