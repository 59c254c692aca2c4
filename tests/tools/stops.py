"""The table of stopping distances in docs/safety.md: what servod states of some joints, by each guard of the drive."""

from __future__ import annotations

import math
from typing import Any

from tables import markdown

from servod.common.shipped import shipped
from servod.common.yaml import validate
from servod.formats.config import AxisConfig
from servod.formats.stopping import with_stopping
from servod.qualify.faults.scenario import merged, shipped_config

_LIMITS = {"torque_nm": 0.3, "speed_rad_s": 3.0, "position_min_rad": -0.6, "position_max_rad": 0.6, "stale_cycles": 5}
_LIGHT = {"least_inertia": 0.001, "least_friction_nm": 0.005}
_HEAVY = {"least_inertia": 0.02, "least_friction_nm": 0.02}
_HANGING = {"least_inertia": 0.004, "least_friction_nm": 0.01, "load_min_nm": -0.06}
#: Name -> the axis's own keys.
JOINTS: dict[str, dict[str, Any]] = {
    "demo joint, by its model": {"model": str(shipped("gains/axes/demo_joint.yaml"))},
    "light: 0.001 kg·m², 0.005 N·m": {"stopping": _LIGHT},
    "heavy: 0.02 kg·m², 0.02 N·m": {"stopping": _HEAVY},
    "heavy, `within_s: 0.5`": {"stopping": {**_HEAVY, "within_s": 0.5}},
    "hanging: 0.004 kg·m², load 0.06 N·m": {"stopping": _HANGING},
}
_GUARDS = {"20 ms": 0.02, "100 ms": 0.1}


def stops_table() -> str:
    """Limits as narrowed, and the stop: time, speed, ways, energy."""
    header = (
        "Joint",
        "Reaction",
        "Speed limit",
        "Torque at rest, at speed",
        "Torque gone",
        "Speed",
        "Way",
        "Coasts",
        "J",
    )
    rows = []
    for name, own in JOINTS.items():
        config = validate(merged(shipped_config(), {"limits": _LIMITS, **own}), AxisConfig, name)
        for guard, reaction_s in _GUARDS.items():
            stopping = with_stopping(config, reaction_s)[1]
            assert stopping is not None
            coasts = f"{stopping.coasts_rad:.2f}" if math.isfinite(stopping.coasts_rad) else "does not rest"
            rows.append([
                name,
                guard,
                f"{stopping.facts.speed_rad_s:.2f}",
                f"{stopping.torque_at_rest_nm:.3f}, {stopping.torque_at_speed_nm:.3f}",
                f"{1e3 * stopping.time_s:.0f} ms",
                f"{stopping.speed_rad_s:.2f}",
                f"{stopping.travel_rad:.3f}",
                coasts,
                f"{stopping.energy_j:.2g}",
            ])  # fmt: skip
    return markdown(header, rows)
