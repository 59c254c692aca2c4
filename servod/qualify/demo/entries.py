"""The rows of the demo's comparison: the four controllers, any further gain sets, the certified one; what each uses.

Beside the data path. A comparison is fair only when it says which options a law had; `options_of` reads them from
its gain set.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import GainSet, load_gains, require_fit
from servod.formats.gains.parameters import LocalParameters, PdDobParameters, PdLugreParameters
from servod.kernels.laws import LABELS
from servod.qualify.demo.axis import CERTIFIED, CERTIFIED_LABEL, CONTROLLERS, demo_config, gains_file
from servod.qualify.demo.certified import Margins, margins

#: Gain sets that run beside the four controllers where that is cheap: the local law without options, and the paper's
#: Table I in both readings of its gain labels.
FURTHER = ("demo_local_plain", "table1_kz_kv_kx", "table1_kx_kv_kz")


class Entry(NamedTuple):
    """One row: key in the JSON document, what people read, options of the law, gain-set file, margins if certified."""

    name: str
    label: str
    options: str
    gains: Path
    margins: Margins | None = None


def entries(further: Sequence[Path] = (), certified: bool = False) -> list[Entry]:
    """The four controllers, then `further` gain sets by their names, then the shipped set that is certified, if asked.

    Raises BadInput for a bad or repeated set, and for one that the demo's axis may not run.
    """
    rows = [_entry(c, LABELS[c], gains_file(c)) for c in CONTROLLERS]
    last = [_entry(CERTIFIED, CERTIFIED_LABEL, gains_file(CERTIFIED))] if certified else []
    for file in further:
        name = load_gains(file).name
        if name in {row.name for row in (*rows, *last)}:
            raise BadInput(f"--gains {file}: name", name, "a name that no other row of the table has")
        rows.append(_entry(name, name, file))
    return rows + last


def _entry(name: str, label: str, file: Path) -> Entry:
    """The row of one gain-set file; a set of another loop is refused here, before anything runs."""
    gains = load_gains(file)
    require_fit(gains, demo_config(Path(), Path()), str(file))
    return Entry(name, label, options_of(gains), file, margins(gains))


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
            *(["inertia fed forward"] if parameters.feedforward_inertia_kg_m2 else []),
            *(["torque over position fed forward"] if parameters.position_feedforward else []),
        ]
    )
