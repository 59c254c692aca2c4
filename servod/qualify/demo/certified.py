"""What the certificate of a gain set promises, in the units of a drive engineer: the margins that the demo shows.

Beside the data path; reads the certificate that stands in the set, and computes no loop.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from servod.formats.gains.gain_set import GainSet

#: Checks and observations of `servoctl verify` that are told, by their names in a certificate.
_PLANTS, _DISK = "plants of the Monte-Carlo", "symmetric disk margin"
_DELAY, _FRICTION = "largest tolerated delay [s]", "largest tolerated friction scale"
_INERTIA = "least tolerated inertia scale", "largest tolerated inertia scale"


class Margins(NamedTuple):
    """Margins of a certified loop at its worst speed; scales are factors on the identified value, each alone."""

    plants: int  # drawn from the identified intervals, all of which passed
    gain_margin_db: float  # at least, either way
    phase_margin_deg: float  # at least
    delay_ms: float  # command to torque, as identified
    tolerated_delay_ms: float
    tolerated_inertia: tuple[float, float]
    tolerated_friction: float

    def __str__(self) -> str:
        low, high = self.tolerated_inertia
        return (
            f"certified with {self.plants} of {self.plants} plants drawn from the identified intervals; gain margin "
            f"at least {self.gain_margin_db:.2f} dB, phase margin at least {self.phase_margin_deg:.1f}°, at the worst "
            f"speed; stable with a delay up to {self.tolerated_delay_ms:.2f} ms ({self.delay_ms:.2f} ms identified), "
            f"{low:.2f} to {high:.2f} times the inertia, up to {self.tolerated_friction:.2f} times the friction"
        )


def margins(gains: GainSet) -> Margins | None:
    """The margins of a set whose certificate counts and that was designed; None for any other."""
    certificate, design = gains.certificate, gains.design
    if certificate is None or design is None or gains.certificate_problem() is not None:
        return None
    checks = {check.name: check.value for check in certificate.checks}
    told = certificate.observations
    if not {_PLANTS, _DISK} <= checks.keys() or not {_DELAY, _FRICTION, *_INERTIA} <= told.keys():
        return None  # of another version of the checks
    alpha = checks[_DISK]  # gain by (2 + alpha)/(2 - alpha), phase by 2*atan(alpha/2): Seiler, Packard, Gahinet 2020
    return Margins(
        plants=round(checks[_PLANTS]),
        gain_margin_db=20.0 * math.log10((2.0 + alpha) / (2.0 - alpha)),
        phase_margin_deg=math.degrees(2.0 * math.atan(0.5 * alpha)),
        delay_ms=1e3 * design.model.total_delay_s,
        tolerated_delay_ms=1e3 * told[_DELAY],
        tolerated_inertia=(told[_INERTIA[0]], told[_INERTIA[1]]),
        tolerated_friction=told[_FRICTION],
    )
