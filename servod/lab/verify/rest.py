"""What may count as a joint at rest: the width that rounding and noise of the encoder make, and no more.

Stands on a design alone. Synthesis takes the widths from here, and verification compares a set with them: within the
width most of the feedback is off, so a set that calls more of its travel rest is another law than the one judged.
"""

from __future__ import annotations

from servod.formats.gains.design import Design
from servod.lab.simulate.noise import noise_of
from servod.lab.verify.rounding import count_rad

HOLD_COUNTS = 0.6  # hold width in encoder counts: what rounding hides, and no more, for the joint creeps as far
REST_SIGMAS = 5.0  # of the encoder's noise, beyond the hold width, within which a joint counts as at rest
#: Of feedback and observer: with less a joint creeps under a load for seconds, and its noise hunts instead.
LEAST_SHARE = 0.2


def hold_width(design: Design) -> float:
    """Error that rounding alone may hide [rad]; 0 where the encoder has no steps."""
    return HOLD_COUNTS * count_rad(design)


def rest_width(design: Design) -> float:
    """Error that rounding and noise of the encoder may show of a joint that stands where it shall [rad]."""
    noise = noise_of(design.model, count_rad(design))
    return hold_width(design) + (REST_SIGMAS * noise.encoder_rms if noise else 0.0)
