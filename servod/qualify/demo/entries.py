"""The rows of the demo's comparison: the four controllers, any further gain sets, the certified one; what each uses.

Beside the data path. A comparison is fair only when it says which options a law had; `options_of` reads them from
its gain set.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import GainSet, load_gains, require_fit
from servod.formats.gains.parameters import LocalParameters, PdDobParameters, PdLugreParameters
from servod.kernels.laws import LABELS
from servod.qualify.demo.axis import CERTIFIED, CERTIFIED_LABEL, CONTROLLERS, demo_config, gains_file

# --- Margins ---------------------------------------------------------------------------------------------------------
# What the certificate of a gain set promises, in the units of a drive engineer: the margins that the demo shows. Reads
# the certificate that stands in the set, and computes no loop.


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
    observations = certificate.observations
    if not {_PLANTS, _DISK} <= checks.keys() or not {_DELAY, _FRICTION, *_INERTIA} <= observations.keys():
        return None  # of another version of the checks
    alpha = checks[_DISK]  # gain by (2 + alpha)/(2 - alpha), phase by 2*atan(alpha/2): Seiler, Packard, Gahinet 2020
    return Margins(
        plants=round(checks[_PLANTS]),
        gain_margin_db=20.0 * math.log10((2.0 + alpha) / (2.0 - alpha)),
        phase_margin_deg=math.degrees(2.0 * math.atan(0.5 * alpha)),
        delay_ms=1e3 * design.model.total_delay_s,
        tolerated_delay_ms=1e3 * observations[_DELAY],
        tolerated_inertia=(observations[_INERTIA[0]], observations[_INERTIA[1]]),
        tolerated_friction=observations[_FRICTION],
    )


#: Gain sets that run beside the four controllers where that is cheap: the local law without options, and the paper's
#: Table I in both readings of its gain labels.
FURTHER = ("demo_local_plain", "table1_kz_kv_kx", "table1_kx_kv_kz")


class DemoRow(NamedTuple):
    """One row: key in the JSON document, what people read, options of the law, gain-set file, margins if certified."""

    name: str
    label: str
    options: str
    gains: Path
    margins: Margins | None = None


def entries(further: Sequence[Path] = (), certified: bool = False) -> list[DemoRow]:
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


def _entry(name: str, label: str, file: Path) -> DemoRow:
    """The row of one gain-set file; a set of another loop is refused here, before anything runs."""
    gains = load_gains(file)
    require_fit(gains, demo_config(Path(), Path()), str(file))
    return DemoRow(name, label, options_of(gains), file, margins(gains))


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
            f"{friction.velocity.value.replace('_', ' ')} velocity",
            f"observer {observer.bandwidth_rad_s:g} rad/s" if observer else "no observer",
            f"{regions} feedback",
            *(["inertia fed forward"] if parameters.feedforward_inertia_kg_m2 else []),
            *(["torque over position fed forward"] if parameters.position_feedforward else []),
        ]
    )
