"""Fair tuning of all laws: one optimiser, one budget, one set of plants, one limit on roughness, two classes.

plan.py       class, budget and limits of a tuning, and its result
laws.py       what is tuned of each law, the axis it is for, and the one friction curve that LuGre's observer can hold
tuning.py     one law in one class: what a set costs on the plants of a tuning, and the bounded optimiser
rivals.py     all of them, over worker processes
"""

from __future__ import annotations

from servod.lab.tune.plan import Feedback, Tuned, TuningSettings
from servod.lab.tune.rivals import rivals
from servod.lab.tune.tuning import tune

__all__ = ["Feedback", "Tuned", "TuningSettings", "rivals", "tune"]
