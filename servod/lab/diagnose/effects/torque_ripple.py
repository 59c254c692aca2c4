"""Torque ripple: the motor's torque for the same command changes with position."""

from __future__ import annotations

from servod.formats.model.effects import TorqueRipple
from servod.lab.diagnose.effects.effect import Effect, sine_term
from servod.lab.diagnose.effects.hypothesis import Document, Term
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import SearchContext

#: Torque ripple below this share of the command is what every motor has.
LEAST_SHARE = 0.02


def terms(scene: SearchContext) -> list[Term]:
    """Sines whose period is searched, and with the second harmonic."""
    peaks = scene.peaks(scene.carried(scene.torque), 2)
    found = [sine_term("torque_ripple", scene, peak, 0.1, "1", most=0.45) for peak in peaks]
    return [*found, sine_term("torque_ripple", scene, peaks[0], 0.1, "1", most=0.45, multiples=2)]


def _at_level(_nominal: Document, fitted: Document) -> bool:
    waves = fitted.get("torque_ripple", {}).get("harmonics", [])
    return max((float(wave["amplitude"]) for wave in waves), default=0.0) >= LEAST_SHARE


EFFECT = Effect(
    name="torque_ripple",
    group=TorqueRipple,
    equation="torque = command*(1 + sum amplitude*sin(n*x + phase))",
    source="Jahns and Soong, IEEE Trans. Industrial Electronics 43(2), 1996",
    statement="The torque that the drive makes of a command changes along the way: torque ripple",
    shows="a mismatch periodic in position whose size and sign follow the command",
    confused=("cogging", "position_dependent_inertia", "encoder_eccentricity"),
    experiment="slow passes with different loads: what grows with the load is ripple",
    terms=terms,
    look=Look("position", Split.LOAD, periodic=True),
    swift=True,
    repeatable=True,
    soaks_up=True,
    at_level=_at_level,
)
