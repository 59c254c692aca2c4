"""How much of feedback and observer is left of a joint at rest: as little as its loops at rest stand.

Stands after the search for an observer. At rest a joint stands on its bristle, and what feedback adds is the encoder's
noise: less of it keeps the joint where it is, yet where friction falls steeply with speed too little lets it hunt.
"""

from __future__ import annotations

from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters
from servod.lab.verify.checks import Subject
from servod.lab.verify.rest_checks import RESTING_POLE, resting_radius, resting_speed

#: Best first: at 20 bit the first holds a joint within 5 urad, all of the feedback within 15 to 45.
SHARES = (0.3, 0.45, 0.6, 0.8, 1.0)


def with_share_at_rest(gains: GainSet) -> GainSet:
    """`gains` with the least share at rest with which every corner stands, or else with all of it; sealed."""
    for share in SHARES:
        found = gains.model_copy(
            update={"parameters": gains.parameters.model_copy(update={"rest_share": share})}
        ).sealed()
        if stands_at_rest(found):
            break
    return found


def stands_at_rest(gains: GainSet) -> bool:
    """Whether the loops at rest are inside by what verification asks of them."""
    law, design = gains.parameters, gains.design
    assert isinstance(law, LocalParameters) and design is not None
    if not law.rest_within_rad:
        return True
    subject = Subject(gains, design, plants=0, seed=0, processes=1)
    return resting_radius(subject, law, resting_speed(law.rest_within_rad)) <= RESTING_POLE
