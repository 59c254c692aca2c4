"""The shape of an effect's file, and writers that many of them share.

Every effect is one file with one `EFFECT`: what it is (for people and for `servoctl explain`), and how to look for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from servod.formats.model.keys import Group
from servod.lab.diagnose.effects.base import BACK_EMF, DRIVE_SCALES
from servod.lab.diagnose.effects.hypothesis import LEVEL, Document, Reported, Reporter, Term, Unknown, Writer, get, put
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import Peak, SearchContext

#: By how much the model's own delay may be off beside a lag, s.
OWN_DELAY_S = 0.0002


#: Numbers of a drive beside which the model's friction is in a torque that somebody assumed, and is free anyway.
ANOTHER_DRIVE = (*DRIVE_SCALES, BACK_EMF)

#: How well a level of the model's own friction is known beforehand, as a factor, and by which it is off at most.
LEVEL_KNOWN, LEVEL_MOST = 3.0, 30.0


@dataclass(frozen=True)
class Effect:
    """One effect by its name in the outside contract.

    `group` is its group of keys in the axis model file, under its name; None where the name is a plain key of every
    model, or the effect is one of the drive: then `drive_keys` are the keys of that. `friction_keys` are keys of the
    model's own friction that it works on beside. `statement` says in one
    sentence what was left out; `shows` where its signature is and `look` how that is drawn; `confused` what it is
    mistaken for and `experiment` what tells them apart. `terms` gives its forms with start values for a scene, none
    where it cannot act.

    For the search: `far` effects are also started from the nominal model, whose refit they distort; `swift` ones show
    against the inertia alone, not on an axis that creeps; `directed` ones tell one direction from the other;
    `repeatable` ones may come in again with another period or place (a second harmonic is no second effect); where a
    number of the drive that is `one_with` theirs is fitted, they are not tried; those
    that `soaks_up` take what others leave, and are too plain to be a detail where they are real; numbers of the model's
    own that may all be off at once are tried `jointly` too. An effect is a special
    case of those it is `within`, which leave as little with more numbers and are no rivals.

    For the verdict: `at_level` says of the nominal and the fitted model whether the effect is more than recalibration;
    with one that `scales_torques`, no recording tells the common factor on all torques of the axis. Of an effect and
    what it makes a `product_with` a servo shows that alone while its duty is below the limit. An effect and its
    `twin` that are in together are one finding, by the name of the one that makes the torque later: `lateness` is the
    key that says by how much. One that is `resonant` stays in the model by its name alone: a feedback has to be stable
    with a resonance, and one too small for a name is no ground to give stiffness away.
    """

    name: str
    group: type[Group] | None
    equation: str
    source: str
    statement: str
    shows: str
    confused: tuple[str, ...]
    experiment: str
    terms: Callable[[SearchContext], list[Term]]
    look: Look
    friction_keys: tuple[str, ...] = ()
    drive_keys: tuple[str, ...] = ()
    far: bool = False
    swift: bool = False
    directed: bool = False
    repeatable: bool = False
    one_with: tuple[str, ...] = ()
    soaks_up: bool = False
    jointly: bool = False
    within: tuple[str, ...] = ()
    at_level: Callable[[Document, Document], bool] = lambda _nominal, _fitted: True
    scales_torques: bool = False
    product_with: str = ""
    twin: str = ""
    lateness: str = ""
    resonant: bool = False


def share(key: str, start: float, low: float, high: float, size: float, unit: str = "1") -> Unknown:
    """An unknown whose coordinate is value/size."""
    return Unknown(key, unit, start, low, high, size)


def positive(key: str, unit: str, start: float, factor: float = 1000.0) -> Unknown:
    """An unknown of one sign whose coordinate is its logarithm, within a factor of its start."""
    return Unknown(key, unit, start, start / factor, start * factor)


def report_as_is(unknowns: Sequence[Unknown]) -> Reporter:
    """A term whose unknowns are what is reported."""
    return lambda _document, values: [Reported(u.key, v, u.unit) for u, v in zip(unknowns, values, strict=True)]


def keys(group: str, names: Sequence[str], **fixed: float | str) -> Writer:
    """A writer of values into keys of one group, beside fixed ones."""

    def write(document: Document, values: Sequence[float]) -> None:
        found = document.setdefault(group, {})
        found.update(fixed)
        found.update(zip(names, values, strict=True))

    return write


def simple(effect: str, form: str, unknowns: Sequence[Unknown], **fixed: float | str) -> Term:
    """A term whose unknowns are keys of the effect's own group."""
    write = keys(effect, [u.key for u in unknowns], **fixed)
    return Term(effect, form, tuple(unknowns), write, report_as_is(unknowns))


def level(effect: str, nominal: Document, scales: tuple[str, ...], report: Reporter) -> Term:
    """A term that is one factor on numbers of the model's own, which start at what they are in `nominal` beside it."""

    def write(document: Document, values: Sequence[float]) -> None:
        for key in scales:
            if get(document, key) > 0.0:
                put(document, key, values[0] * get(document, key))

    own = level_factor()
    begins = {key: get(nominal, key) for key in scales if get(nominal, key) > 0.0}
    return Term(effect, "level", (own,), write, report, begins=begins, scales=scales)


def level_factor() -> Unknown:
    """A factor on what the model says: 1 is no effect, and a few times more or less no surprise."""
    return Unknown(LEVEL, "1", 1.0, 1.0 / LEVEL_MOST, LEVEL_MOST, spread=math.log(LEVEL_KNOWN))


def scale_friction(document: Document, dry: float, viscous: float) -> None:
    """Dry and viscous friction of a document times these factors; the torques of a map have both in them."""
    law = document["friction"]
    if law["kind"] == "local":
        parts = [law.get("viscous", 0.0) * v for v in law["velocities"]]
        law["torques"] = [
            t + (dry - 1.0) * (t - part) + (viscous - 1.0) * part for t, part in zip(law["torques"], parts, strict=True)
        ]
    for key, factor in (("coulomb", dry), ("static", dry), ("viscous", viscous)):
        if key in law:
            law[key] *= factor


#: The torques of a friction map, dry and viscous together.
MAP = "friction.torques"


def map_level(effect: str, dry: bool) -> Term:
    """A factor on the dry or on the viscous part of a friction map, whose torques have both in them."""

    def write(document: Document, values: Sequence[float]) -> None:
        scale_friction(document, *((values[0], 1.0) if dry else (1.0, values[0])))

    def report(_document: Document, values: Sequence[float]) -> list[Reported]:
        return [Reported("over_model", values[0], "1")]

    scales = (MAP,) if dry else (MAP, "friction.viscous")
    return Term(effect, "level", (level_factor(),), write, report, scales=scales)


def of_drive(effect: str, form: str, unknowns: Sequence[Unknown]) -> Term:
    """A term whose unknowns are keys of the model's drive, which acts where a recording has no torque."""
    return Term(effect, form, tuple(unknowns), keys("drive", [u.key for u in unknowns]), report_as_is(unknowns))


def known_delay(document: Document) -> dict[str, tuple[float, float]]:
    """Bounds of the model's own delay beside a lag, which would share a longer one with it."""
    own = get(document, "delay_s", 0.001)
    return {"delay_s": (max(own - OWN_DELAY_S, 0.0), own + OWN_DELAY_S)}


def harmonic(scene: SearchContext, n: float, amplitude: float, phase: float) -> Document:
    """One sine over position as the axis model file has it."""
    if scene.linear:
        return {"amplitude": amplitude, "periods_per_metre": n / (2.0 * math.pi), "phase": phase}
    return {"amplitude": amplitude, "periods_per_turn": n, "phase": phase}


def sine_term(
    effect: str,
    scene: SearchContext,
    peak: Peak,
    size: float,
    unit: str,
    *,
    most: float,
    multiples: int = 1,
    free: bool = True,
) -> Term:
    """A sum of sines over position: order n (unless not `free`) and a sine and cosine for each multiple of it.

    `size` is the natural size of the amplitudes, `most` their bound.
    """
    width = 2.0 * math.pi / scene.reach
    unknowns = []
    if free:
        low = max(peak.n - width, 0.3 * peak.n)
        unknowns.append(Unknown("n", f"1/{scene.length}", peak.n, low, peak.n + width, 1.0 / scene.reach))
    for multiple in range(1, multiples + 1):
        first = multiple == 1
        for name, start in (("sine", peak.sine if first else 0.0), ("cosine", peak.cosine if first else 0.0)):
            clipped = min(max(start, -0.7 * most), 0.7 * most)
            unknowns.append(Unknown(f"{name}_{multiple}", unit, clipped, -most, most, size))

    def sines(values: Sequence[float]) -> list[tuple[float, float, float]]:
        n = values[0] if free else peak.n
        pairs = values[1:] if free else values
        return [
            ((k // 2 + 1) * n, math.hypot(pairs[k], pairs[k + 1]), math.atan2(pairs[k + 1], pairs[k]))
            for k in range(0, len(pairs), 2)
        ]

    def write(document: Document, values: Sequence[float]) -> None:
        rows = document.setdefault(effect, {}).setdefault("harmonics", [])
        rows.extend(harmonic(scene, n, a, phase) for n, a, phase in sines(values))

    def report(_document: Document, values: Sequence[float]) -> list[Reported]:
        return report_sines(scene, sines(values), unit)

    return Term(effect, f"{multiples} sines" if multiples > 1 else "sine", tuple(unknowns), write, report)


def report_sines(scene: SearchContext, sines: Sequence[tuple[float, float, float]], unit: str) -> list[Reported]:
    """What is reported of sines over position: periods, amplitude, phase of each."""
    found = []
    for row, (n, amplitude, phase) in enumerate(sines):
        tail = f"_{row + 1}" if row else ""
        if scene.linear:
            found.append(Reported(f"periods_per_metre{tail}", n / (2.0 * math.pi), "1/m"))
        else:
            found.append(Reported(f"periods_per_turn{tail}", n, "1"))
        found += [Reported(f"amplitude{tail}", amplitude, unit), Reported(f"phase{tail}", phase, "rad")]
    return found
