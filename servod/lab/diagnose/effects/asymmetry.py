"""Asymmetry: friction differs by direction."""

from __future__ import annotations

import math
from collections.abc import Sequence

from servod.formats.model.friction import Asymmetry
from servod.lab.diagnose.effects.effect import Effect, positive, share
from servod.lab.diagnose.effects.hypothesis import PLAINER_FACTOR, Document, Reported, Reporter, Term, Writer, get
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: The least by which the ratio of one direction's friction to the other's is off the model's (its logarithm): half of
#: it is the least share of dry friction that is worth a name.
LEAST_LOG_RATIO = 0.06


def _write(document: Document, values: Sequence[float]) -> None:
    """Values: half the difference of dry friction, that of viscous friction, and a factor on all of it.

    Friction that differs in one direction alone has another mean than the model's, dry and viscous alike.
    """
    dry, viscous, level = (*values, 1.0)[:3]
    document["asymmetry"] = {
        "positive_dry": level * (1.0 + dry),
        "negative_dry": level * (1.0 - dry),
        "positive_viscous": level * (1.0 + viscous),
        "negative_viscous": level * (1.0 - viscous),
    }


def _write_dry(document: Document, values: Sequence[float]) -> None:
    """Dry friction alone: half the difference, and a factor on both directions."""
    dry, level = (*values, 1.0)[:2]
    sides = {"positive_dry": level * (1.0 + dry), "negative_dry": level * (1.0 - dry)}
    document["asymmetry"] = sides | {"positive_viscous": 1.0, "negative_viscous": 1.0}


def _reporter(write: Writer) -> Reporter:
    """The ratio of friction for v < 0 to that for v > 0, and the factors themselves."""

    def report(_document: Document, values: Sequence[float]) -> list[Reported]:
        written: Document = {}
        write(written, values)
        found = [Reported("negative_over_positive", (1.0 - values[0]) / (1.0 + values[0]), "1")]
        return found + [Reported(key, value, "1") for key, value in written["asymmetry"].items()]

    return report


def terms(_scene: SearchContext) -> list[Term]:
    """Dry friction by direction, and dry and viscous friction; each also with another level than the model's."""
    dry = share("dry", 0.0, -0.9, 0.9, 1.0)
    viscous = share("viscous", 0.0, -0.9, 0.9, 1.0)
    level = positive(PLAINER_FACTOR, "1", 1.0, 3.0)
    forms = {
        "both": (_write, (dry, viscous)),
        "dry": (_write_dry, (dry,)),
        "both, another level": (_write, (dry, viscous, level)),
        "dry, another level": (_write_dry, (dry, level)),
    }
    return [Term("asymmetry", form, unknowns, write, _reporter(write)) for form, (write, unknowns) in forms.items()]


def _at_level(nominal: Document, fitted: Document) -> bool:
    """Whether the directions differ otherwise than the model's do: one factor on both is a level."""
    for part in ("dry", "viscous"):
        was, now = (
            get(document, f"asymmetry.positive_{part}", 1.0) / get(document, f"asymmetry.negative_{part}", 1.0)
            for document in (nominal, fitted)
        )
        if abs(math.log(now / was)) >= LEAST_LOG_RATIO:
            return True
    return False


EFFECT = Effect(
    name="asymmetry",
    group=Asymmetry,
    equation="g(v) -> k(sign v)*g(v),  F_v -> k_v(sign v)*F_v",
    source="Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994; maps signed per direction",
    statement="Friction differs by direction",
    shows="a step of the mismatch where the velocity changes sign, the same at every position and load",
    confused=("torque_offset", "torque_gain", "spring"),
    experiment="constant speeds in both directions over the same range: half the difference of the torques",
    terms=terms,
    look=Look("velocity"),
    directed=True,
    at_level=_at_level,
)
