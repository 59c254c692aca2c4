"""Anti-windup of the friction state: no integral action into a limit that already holds.

Stands under `pd_lugre` and `local`. The disturbance observer needs none, it works with the torque after limits.
"""

from __future__ import annotations

from collections.abc import Sequence

from servod.kernels.laws.state import ASKED

LIMITED_NM = 1e-9  # less difference than this between asked and applied is rounding


def winds_up(s: Sequence[float], push: float, u_applied: float) -> bool:
    """Whether the limits cut the last torque (asked against applied) and `push` would ask for still more of it."""
    cut = s[ASKED] - u_applied
    return (cut > LIMITED_NM and push > 0.0) or (cut < -LIMITED_NM and push < 0.0)
