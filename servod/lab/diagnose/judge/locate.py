"""Where a mismatch lives: over time, position, velocity, direction, acceleration, load, temperature, frequency.

Stands between mismatches and the report. Every map is a mean over bins with a test against what noise would make of
them, and the share of the mismatch that it carries; the first picture shows them before any physics is named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.coordinates import coordinates, units
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import MismatchMap
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


def maps(predictor: Predictor, mismatch: Array) -> list[MismatchMap]:
    """Maps over all coordinates, the one that carries most first, and at the end what is everywhere alike."""
    memory = max(1, round(2.0 / (predictor.rate * predictor.traces[0].period_s)))
    bins = {"time": SETTINGS.maps.time_bins}
    found = [
        map_over(name, unit, values, mismatch, predictor.counts, memory, bins.get(name, SETTINGS.maps.bins))
        for name, (unit, values) in coordinates(predictor).items()
        if int(np.sum(predictor.counts & np.isfinite(values))) >= 2 * SETTINGS.maps.least_in_bin
    ]
    found.append(map_modulo_period(predictor, mismatch, memory))
    return [*sorted(found, key=lambda m: -m.share), constant_part(predictor, mismatch, memory)]


def constant_part(predictor: Predictor, mismatch: Array, memory: int) -> MismatchMap:
    """The part of the mismatch that is the same in all rows, as a map of one bin."""
    from scipy.stats import f as fisher

    here = mismatch[predictor.counts]
    mean, power, rows = float(np.mean(here)), max(float(np.mean(here**2)), 1e-30), max(len(here) / memory, 2.0)
    spread = max(power - mean**2, 1e-30) / rows
    chance = float(fisher.sf(mean**2 / spread, 1, rows - 1.0))
    bins = np.array([0.0, 1.0]), np.array([mean]), np.array([math.sqrt(spread)]), np.array([len(here)])
    return _map("everywhere alike", "1", *bins, mean**2 / power, chance)


def _map(
    name: str, unit: str, edges: Array, mean: Array, error: Array, rows: NDArray[Any], share: float, chance: float
) -> MismatchMap:
    """The map of those bins that hold rows enough."""
    full = rows >= SETTINGS.maps.least_in_bin
    middles = 0.5 * (edges[:-1] + edges[1:])
    return MismatchMap(name, unit, middles[full], mean[full], error[full], len(rows), share, chance)


def map_modulo_period(predictor: Predictor, mismatch: Array, memory: int) -> MismatchMap:
    """The map over the position modulo the period that takes most; its chance counts all periods that were tried."""
    axis = "linear" if predictor.linear else "rotary"
    scene = SearchContext({"axis": axis}, predictor, mismatch)
    best = scene.peaks(scene.carried(np.ones_like(scene.position)), 1)[0]
    period, unit = 2.0 * math.pi / best.n, units(predictor).length
    name = f"position modulo {period:.4g} {unit}"
    found = map_over(name, unit, scene.lagged_position % period, mismatch, predictor.counts, memory, SETTINGS.maps.bins)
    return replace(found, chance=min(1.0, found.chance * len(scene.orders)))


def map_over(
    name: str,
    unit: str,
    values: Array,
    mismatch: Array,
    counts: NDArray[np.bool_],
    memory: int,
    bins: int,
) -> MismatchMap:
    """Means of the mismatch over bins of `values` with as many rows each; `memory` rows count as one.

    Share and chance are of what differs between the bins; what is everywhere alike is no matter of a coordinate.
    """
    from scipy.stats import f as fisher

    rows = counts & np.isfinite(values)
    edges = np.unique(np.quantile(values[rows], np.linspace(0.0, 1.0, bins + 1)))
    if len(edges) < 3:
        edges = np.array([edges[0] - 0.5, edges.mean(), edges[-1] + 0.5])
    bin_index = np.clip(np.searchsorted(edges, values[rows], side="right") - 1, 0, len(edges) - 2)
    here, count = mismatch[rows], np.bincount(bin_index, minlength=len(edges) - 1)
    mean = np.bincount(bin_index, here, len(edges) - 1) / np.maximum(count, 1)
    square = np.bincount(bin_index, here**2, len(edges) - 1) / np.maximum(count, 1)
    independent = np.maximum(count / memory, 1.0)
    error = np.sqrt(np.maximum(square - mean**2, 0.0) / independent)
    alike = float(np.mean(here))
    total, between = float(here @ here) - len(here) * alike**2, float(count @ (mean - alike) ** 2)
    free, rest = max(len(edges) - 2, 1), max(len(here) / memory - len(edges) + 1, 1.0)
    ratio = (between / free) / max((total - between) / rest, 1e-30) / memory
    carried = max(between - free * memory * (total - between) / max(len(here), 1), 0.0)
    share = carried / max(float(np.sum(mismatch[counts] ** 2)), 1e-30)
    return _map(name, unit, edges, mean, error, count, share, float(fisher.sf(ratio, free, rest)))


def locate(predictor: Predictor, effect: Array, scale: float) -> dict[str, Any]:
    """Where an effect acts: what it changes of the mismatch (`effect`, N*m), recording by recording and by coordinate.

    `scale` is dry friction; sizes are told as shares of it.
    """
    found: dict[str, Any] = {"recordings": {}, "time_windows": []}
    for part, trace in zip(predictor.slices, predictor.traces, strict=True):
        here = effect[part]
        found["recordings"][trace.name] = round(float(np.sqrt(np.mean(here**2))) / scale, 4)
        found["time_windows"] += _windows(trace.name, trace.drive.t_s - trace.shift_s, here)
    for name, (unit, values) in coordinates(predictor).items():
        if name != "time" and "," not in name:
            found[name.replace(" ", "_")] = _strong(values, effect, predictor.counts) | {"unit": unit}
    found["unit"] = units(predictor).force
    found["frequency"] = bands(predictor, effect) | {"unit": "Hz"}
    return found


def _windows(name: str, t_s: Array, effect: Array, length_s: float = 0.5) -> list[dict[str, Any]]:
    """The stretch of time in which the effect is strongest."""
    rows = max(1, round(length_s / float(np.median(np.diff(t_s)))))
    count = len(effect) // rows
    if count == 0:
        return []
    power = (effect[: count * rows].reshape(count, rows) ** 2).mean(axis=1)
    best = int(np.argmax(power))
    low, high = best, best
    while low > 0 and power[low - 1] > SETTINGS.maps.strong * power[best]:
        low -= 1
    while high + 1 < count and power[high + 1] > SETTINGS.maps.strong * power[best]:
        high += 1
    return [{"recording": name, "start_s": float(t_s[low * rows]), "end_s": float(t_s[(high + 1) * rows - 1])}]


def _strong(values: Array, effect: Array, counts: NDArray[np.bool_]) -> dict[str, Any]:
    """The range of a coordinate in which the effect's power is strong."""
    rows = counts & np.isfinite(values)
    edges = np.unique(np.quantile(values[rows], np.linspace(0.0, 1.0, 13)))
    if len(edges) < 3:
        return {"from": float(values[rows].min()), "to": float(values[rows].max())}
    bin_index = np.clip(np.searchsorted(edges, values[rows], side="right") - 1, 0, len(edges) - 2)
    count = np.maximum(np.bincount(bin_index, minlength=len(edges) - 1), 1)
    power = np.bincount(bin_index, effect[rows] ** 2, len(edges) - 1) / count
    strong = np.flatnonzero(power > SETTINGS.maps.strong * power.max())
    return {"from": float(edges[strong[0]]), "to": float(edges[strong[-1] + 1])}


def bands(predictor: Predictor, effect: Array) -> dict[str, Any]:
    """The band of frequencies that carries most, and the share of each."""
    from scipy.signal import periodogram

    power = np.zeros(len(SETTINGS.maps.bands_hz))
    for part, trace in zip(predictor.slices, predictor.traces, strict=True):
        frequency, density = periodogram(effect[part], 1.0 / trace.period_s)
        power += [float(density[(frequency >= low) & (frequency < high)].sum()) for low, high in SETTINGS.maps.bands_hz]
    shares = power / max(float(power.sum()), 1e-30)
    best = int(np.argmax(shares))
    return {"from": SETTINGS.maps.bands_hz[best][0], "to": SETTINGS.maps.bands_hz[best][1], "shares": _rounded(shares)}


def _rounded(values: Sequence[float] | Array) -> list[float]:
    return [round(float(v), 4) if math.isfinite(v) else 0.0 for v in values]
