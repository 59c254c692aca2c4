"""The rows of the demo's comparison: the four controllers, then any further gain sets, and what each of them uses.

Beside the data path. A comparison is fair only when it says which options a law had; `options_of` reads them from
its gain set.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.gains.parameters import LocalParameters, PdDobParameters, PdLugreParameters
from servod.kernels.laws import LABELS
from servod.qualify.demo.axis import CONTROLLERS, gains_file

#: Gain sets that run beside the four controllers where that is cheap: the local law without options, and the paper's
#: Table I in both readings of its gain labels.
FURTHER = ("demo_local_plain", "table1_kz_kv_kx", "table1_kx_kv_kz")


class Entry(NamedTuple):
    """One row: its key in the JSON document, what people read, the options of its law, and its gain-set file."""

    name: str
    label: str
    options: str
    gains: Path


def entries(further: Sequence[Path] = ()) -> list[Entry]:
    """The four controllers and then `further` gain sets by their names. Raises BadInput for a bad or repeated set."""
    rows = [Entry(c, LABELS[c], options_of(load_gains(gains_file(c))), gains_file(c)) for c in CONTROLLERS]
    for file in further:
        gains = load_gains(file)
        if gains.name in {row.name for row in rows}:
            raise BadInput(f"--gains {file}: name", gains.name, "a name that no other row of the table has")
        rows.append(Entry(gains.name, gains.name, options_of(gains), file))
    return rows


def further_files() -> list[Path]:
    """The shipped files of FURTHER."""
    return [shipped(f"gains/{name}.yaml") for name in FURTHER]


def options_of(gains: GainSet) -> str:
    """What a law has beside its feedback, in words for a table."""
    parameters = gains.parameters
    if isinstance(parameters, PdDobParameters):
        return f"observer {parameters.bandwidth_rad_s:g} rad/s"
    if isinstance(parameters, PdLugreParameters):
        return f"one friction curve for both directions, l_f {parameters.observer_gain:g}"
    if isinstance(parameters, LocalParameters):
        return _local_options(parameters)
    return "none"


def _local_options(parameters: LocalParameters) -> str:
    friction, observer = parameters.friction, parameters.disturbance_observer
    regions = "equal" if parameters.regions.low == parameters.regions.high else "scheduled"
    return ", ".join(
        [
            f"friction map of {len(friction.sets)} velocities",
            f"{friction.velocity.value} velocity",
            f"observer {observer.bandwidth_rad_s:g} rad/s" if observer else "no observer",
            f"{regions} feedback",
        ]
    )
