"""Axes whose torque comes so late that nothing is designed for them: said at once, with what would help.

Beside the LMIs of the deployed mode, which have a state for every command on its way.
"""

from __future__ import annotations

from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws.local import COMMANDS
from servod.lab.verify.sampled import WHOLE

#: Cycles of delay up to which a design is tried. The law feeds the last three commands back; with four the paper's
#: joint has no feedback for Omega_H any more, and from six on the LMIs of an easier axis take minutes.
LONGEST_CYCLES = 5.0


def too_late(model: AxisModel, period_s: float) -> str | None:
    """Why no design is tried for the delay of `model` at this cycle; None where it is short enough."""
    cycles = model.total_delay_s / period_s
    if cycles <= LONGEST_CYCLES + WHOLE:
        return None
    remedy = f"a cycle of {1e3 * model.total_delay_s / LONGEST_CYCLES:.3g} ms and more has it within that"
    return (
        f"too much delay: {1e3 * model.total_delay_s:.3g} ms are {cycles:.3g} cycles, and the law, which feeds "
        f"{COMMANDS} commands back, is designed for up to {LONGEST_CYCLES:g}; {remedy}"
    )
