"""Spring: a torque that grows with the way from a rest position."""

from __future__ import annotations

from collections.abc import Sequence

from servod.formats.model.effects import Spring
from servod.lab.diagnose.effects.effect import Effect, share
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext


def terms(scene: SearchContext) -> list[Term]:
    """A straight and a stiffening spring; the rest position enters as the torque at the middle of the range."""
    size = max(scene.dry, 0.05 * scene.effort)
    half = 0.5 * scene.reach
    middle = 0.5 * float(scene.position.max() + scene.position.min())
    most = 100.0 * size
    unit = f"{scene.force}/{scene.length}"
    stiffness = share("stiffness", 0.2 * size / half, 0.0, most / half, size / half, unit)
    torque = share("torque_at_middle", 0.0, -most, most, size, scene.force)
    units = {"stiffness": unit, "rest": scene.length, "cubic": unit + f"·1/{scene.length}²"}
    cubic = share("cubic", 0.0, 0.0, most / half**3, size / half**3, units["cubic"])

    def written(values: Sequence[float]) -> dict[str, float]:
        rest = middle - values[1] / max(values[0], 1e-3 * size / half)
        group = {"stiffness": values[0], "rest": rest}
        return group | ({"cubic": values[2]} if len(values) > 2 else {})

    def write(document: Document, values: Sequence[float]) -> None:
        document["spring"] = written(values)

    def write_centred(document: Document, values: Sequence[float]) -> None:
        """Both terms from the middle of the range, so that the cubic does not blow up with the rest position."""
        document["spring"] = {"stiffness": values[0], "rest": middle + values[1], "cubic": values[2]}

    def report(_document: Document, values: Sequence[float]) -> list[Reported]:
        return [Reported(key, value, units[key]) for key, value in written(values).items()]

    def report_centred(_document: Document, values: Sequence[float]) -> list[Reported]:
        found: Document = {}
        write_centred(found, values)
        return [Reported(key, value, units[key]) for key, value in found["spring"].items()]

    shift = share("shift", 0.0, -2.0 * scene.reach, 2.0 * scene.reach, half, scene.length)
    return [
        Term("spring", "straight", (stiffness, torque), write, report),
        Term("spring", "stiffening", (stiffness, shift, cubic), write_centred, report_centred),
    ]


EFFECT = Effect(
    name="spring",
    group=Spring,
    equation="resisting torque += stiffness*(x - rest) + cubic*(x - rest)^3",
    source="cables, hoses, gravity balancers, flexure bearings",
    statement="Something pulls the axis back like a spring",
    shows="a mismatch in a straight line over position, the same in both directions and at every speed",
    confused=("gravity", "torque_offset", "cogging"),
    experiment="slow passes over the whole range: gravity turns back, a spring goes on",
    terms=terms,
    look=Look("position"),
)
