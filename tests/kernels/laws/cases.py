"""Parameters that the controller tests share: the paper's, packed by hand, so that packing is tested apart."""

from __future__ import annotations

import math
from typing import Any

from servod.kernels.laws import LAWS, local

SIGMA0, COULOMB, STATIC, STRIBECK_VELOCITY, VISCOUS = 950.0, 0.045, 0.07, 0.1, 0.056
NODES = (-0.5, -0.2, -0.01, -0.001, 0.0, 0.001, 0.05, 0.12, 0.5)


def level(v: float) -> float:
    """g(v) of (18) with Table I."""
    return COULOMB + (STATIC - COULOMB) * math.exp(-((v / STRIBECK_VELOCITY) ** 2))


def local_parameters(
    nodes: tuple[float, ...] = NODES,
    gain: float = 0.0,
    shape: float = 0.0,
    source: float = local.MEASURED,
    leak: float = 0.0,
    hold_within: float = 0.0,
    bandwidth: float = 0.0,
    asymmetry: float = 0.0,
    memory: tuple[float, float, float] = (0.0, 0.0, 0.0),
    error_limit: float = 0.0,
    rest: tuple[float, float] = (0.0, 1.0),
) -> tuple[float, ...]:
    """Local law with the paper's PD gains and the decays that (7) gives for Table I, one direction weaker."""
    decays = [SIGMA0 * abs(v) / (level(v) * (1.0 + math.copysign(asymmetry, v))) for v in nodes]
    head = (0.1, 0.0, 25.0, 1.2, 0.0, 25.0, 1.2, 0.005, 0.02, SIGMA0, VISCOUS, leak, 1e-3, source, 0.0, shape)
    observer = (bandwidth, 0.001, 0.1)
    after = (bandwidth, error_limit, *rest, bandwidth, float(len(nodes)))
    tail = (hold_within, 0.0, *observer, *memory, *memory, *after)
    return (*head, *tail, *nodes, *decays, *([gain] * len(nodes)))


PARAMETERS: dict[str, tuple[float, ...]] = {
    "pd": (2.5, 0.12, 0.001),
    "pd_dob": (2.5, 0.12, 0.001, 50.0, 0.001, 0.0, 0.1, 0.0),
    "pd_lugre": (2.5, 0.12, 0.0, SIGMA0, 1.0, VISCOUS, COULOMB, STATIC, STRIBECK_VELOCITY, 0.04, 0.1, 0.0, 1e-4),
    "local": local_parameters(gain=0.04, bandwidth=50.0, leak=2.0),
}

#: The same by the names that the kernels read.
GAINS: dict[str, Any] = {name: LAWS[name].named(p) for name, p in PARAMETERS.items()}


def local_gains(**options: Any) -> local.LocalGains:
    """`local_parameters` by name."""
    return local.LocalGains.from_flat(local_parameters(**options))
