"""Cogging: a torque over position, periodic, whatever the command."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.effects import Cogging
from servod.lab.diagnose.effects.effect import Effect, harmonic, report_sines, sine_term
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, Unknown
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import Peak, SearchContext

Array = NDArray[np.float64]

#: A motor's slots and poles make whole orders of its turn: way that must be covered (rad), orders searched, most and
#: least that make a comb, and the share of the mismatch that each must take.
WHOLE_TURN, HIGHEST_ORDER, MOST_ORDERS, LEAST_ORDERS, LEAST_SHARE = 5.9, 128, 8, 3, 0.01

#: What repeats once in a turn, within this share of it, is a weight: poles and slots make more waves.
ONCE = 0.15


def terms(scene: SearchContext) -> list[Term]:
    """Sines whose period is searched, and with the second harmonic; whole orders of a turn where there are several."""
    peaks = scene.peaks(scene.carried(-np.ones_like(scene.position)), 3)
    peaks = [peak for peak in peaks if scene.linear or abs(peak.n - 1.0) > ONCE]
    most = 20.0 * max(scene.dry, 0.05 * scene.effort)
    found = [_sines(scene, peak, most, 1) for peak in peaks] + [_sines(scene, peak, most, 2) for peak in peaks[:1]]
    orders = [] if scene.linear or scene.reach < WHOLE_TURN else whole_orders(scene)
    return [*found, _comb(scene, orders, most)] if len(orders) >= LEAST_ORDERS else found


def _sines(scene: SearchContext, peak: Peak, most: float, multiples: int) -> Term:
    """Sines whose order stays on its side of once in a turn: one that is pulled there says that it is a weight."""
    term = sine_term("cogging", scene, peak, scene.dry, scene.force, most=most, multiples=multiples)
    if scene.linear:
        return term
    order, *others = term.unknowns
    if peak.n > 1.0:
        order = replace(order, low=max(order.low, 1.0 + ONCE))
    else:
        order = replace(order, high=min(order.high, 1.0 - ONCE))
    return replace(term, unknowns=(order, *others))


def whole_orders(scene: SearchContext) -> list[int]:
    """Orders of a motor's turn, from two on, that the mismatch holds beside each other, strongest first.

    By matching pursuit; order one is a weight's.
    """
    carried = scene.carried(-np.ones_like(scene.position))
    pairs = dict(scene.pairs(carried, np.arange(2.0, HIGHEST_ORDER + 1.0)))
    wanted = scene.mismatch[scene.thinned]
    total, left = max(float(wanted @ wanted), 1e-30), wanted
    found: list[int] = []
    for _ in range(MOST_ORDERS):
        best = max(
            (n for n in range(2, HIGHEST_ORDER + 1) if n not in found),
            key=lambda n: explained_power(pairs[n], left),
        )
        design = np.column_stack([column for n in (*found, best) for column in pairs[n]])
        after = wanted - design @ np.linalg.lstsq(design, wanted, rcond=None)[0]
        if float(left @ left) - float(after @ after) < LEAST_SHARE * total:
            break
        found.append(best)
        left = after
    return found


def explained_power(pair: tuple[Array, Array], wanted: Array) -> float:
    """Power of `wanted` that a sine and a cosine take, as if they were orthogonal."""
    return sum(float(wanted @ column) ** 2 / max(float(column @ column), 1e-30) for column in pair)


def _comb(scene: SearchContext, orders: list[int], most: float) -> Term:
    """Sines of whole orders of a turn."""
    names = [f"{part}_of_{n}" for n in orders for part in ("sine", "cosine")]
    unknowns = tuple(Unknown(name, scene.force, 0.0, -most, most, scene.dry) for name in names)

    def sines(values: Sequence[float]) -> list[tuple[float, float, float]]:
        pairs = zip(orders, values[::2], values[1::2], strict=True)
        return [(float(n), math.hypot(sine, cosine), math.atan2(cosine, sine)) for n, sine, cosine in pairs]

    def write(document: Document, values: Sequence[float]) -> None:
        rows = document.setdefault("cogging", {}).setdefault("harmonics", [])
        rows.extend(harmonic(scene, n, amplitude, phase) for n, amplitude, phase in sines(values))

    def report(_document: Document, values: Sequence[float]) -> list[Reported]:
        return report_sines(scene, sines(values), scene.force)

    return Term("cogging", "orders of a turn", unknowns, write, report)


EFFECT = Effect(
    name="cogging",
    group=Cogging,
    equation="resisting torque += sum amplitude*sin(n*x + phase)",
    source="Hanselman, Brushless Permanent Magnet Motor Design, 2003",
    statement="A torque that repeats along the way acts whatever the command is: cogging",
    shows="a mismatch periodic in position, the same in both directions and at every command",
    confused=("torque_ripple", "encoder_eccentricity", "gravity", "spring", "position_dependent_friction"),
    experiment="slow passes in both directions with different loads: what stays the same is cogging",
    terms=terms,
    look=Look("position", periodic=True),
    repeatable=True,
)
