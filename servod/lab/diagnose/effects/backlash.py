"""Backlash: a gap before the load."""

from __future__ import annotations

from servod.formats.model.effects import Backlash
from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.effects.two_mass import two_mass_term

#: Gaps to start from, as shares of the range, shares of the load, and resonances of the contact as multiples of the
#: observer's bandwidth.
GAPS, SHARES, RESONANCES = (0.0015, 0.005, 0.015), (0.35, 0.65), (4.0,)


def terms(scene: SearchContext) -> list[Term]:
    """Many starts: the cost has no slope towards a gap that is not there."""
    grid = [(gap, share, fast) for gap in GAPS for share in SHARES for fast in RESONANCES]
    return [
        two_mass_term("backlash", scene, share, fast * scene.predictor.rate, gap=gap * scene.reach)
        for gap, share, fast in grid
    ]


EFFECT = Effect(
    name="backlash",
    group=Backlash,
    equation="tau = 0 while |d| < gap/2, else k*(d - sign(d)*gap/2) + damping*dd/dt,  d = x_motor - x_load",
    source="Nordin, Galic, Gutman, Int. J. Adaptive Control 11, 1997",
    statement="There is a gap between motor and load: backlash",
    shows="short blows behind each reversal: the motor runs free, then meets the load",
    confused=("joint_elasticity", "presliding", "delay"),
    experiment="small fast reversals around rest, and the motor's way when the load is held",
    terms=terms,
    look=Look("time since reversal", Split.DIRECTION),
    far=True,
    swift=True,
    resonant=True,
)
