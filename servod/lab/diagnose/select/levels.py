"""Levels and ranges: when a parameter of the model's own is a finding, and when a fit leans on the end of a range.

Stands between the fit and the stages of the selection. Parameters with a level, pulled beyond it, are findings however
little they move: a softer bristle or a steeper Stribeck curve acts for some milliseconds behind each reversal and is
nothing on average. What came back under its level is recalibration.
"""

from __future__ import annotations

from servod.lab.diagnose.effects.base import BRISTLE_FACTOR, DELAY_S, OFFSET_SHARE, RECALIBRATION, STRIBECK_SHARE
from servod.lab.diagnose.effects.hypothesis import Document, Term, get
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.settings import SETTINGS

#: A delay and a lag that are in together are one finding, by the name of the longer.
TWINS = {"delay": "actuator_lag", "actuator_lag": "delay"}

#: Parameters that the outside contract gives a level, which is their bound until a term opens it.
LEVELS = frozenset(
    ("friction.static", "friction.stribeck_velocity", "friction.sigma0", "friction.sigma1", "torque_offset", "inertia")
)

#: Own numbers of such terms that have no level: damping that fades with speed is judged by the torque that it makes.
NO_LEVEL = frozenset(("damping_velocity",))


def on_bound(fit: Fit) -> bool:
    """Whether a parameter with a level stands on its bound: the data pull it further.

    The Stribeck velocity has none; it opens together with static friction.
    """
    low, high = fit.hypothesis.bounds
    watched = LEVELS - {"friction.stribeck_velocity"}
    places = [i for i, unknown in enumerate(fit.hypothesis.base) if unknown.key in watched]
    return any(min(fit.coordinates[i] - low[i], high[i] - fit.coordinates[i]) < SETTINGS.worth.on_bound for i in places)


def is_level_change(term: Term) -> bool:
    """Whether a term opens parameters that have a level, and no others."""
    own = {unknown.key for unknown in term.unknowns}
    return bool(term.opens) and LEVELS.issuperset(term.opens) and not own & NO_LEVEL


#: Numbers that may lie at an end of their range: where they do not matter, or are known beforehand to a narrow one.
#: A bristle's damping is one of them, the model's own as well as that of a bristle that the model does not have.
MAY_END = frozenset(
    (
        *("damping", "cubic", "exponent", "delay_s", "sigma1", "friction.sigma1"),
        *("friction.stribeck_velocity", "damping_velocity"),
    )
)


def at_end_of_range(fit: Fit, place: int = -1) -> bool:
    """Whether a number of a term (the last), or one of the model's own that it opens, lies at an end of its range.

    Then the effect says itself that it is something else: ranges are wide, and an optimum at an end, twenty times the
    mass or ten times the friction at rest, borrows a shape from an effect that is not there. An end where the number is
    zero is none: there the effect is just absent.
    """
    term, unknowns = fit.hypothesis.terms[place], fit.hypothesis.unknowns
    low, high = fit.hypothesis.bounds
    share = fit.hypothesis.share(place)
    for index, (unknown, at) in enumerate(zip(unknowns, fit.coordinates, strict=True)):
        own = share.start <= index < share.stop or unknown.key in term.opens
        if not own or unknown.key in MAY_END:
            continue
        ends = [end for end, value in ((low[index], unknown.low), (high[index], unknown.high)) if value != 0.0]
        if any(abs(float(at) - float(end)) < SETTINGS.worth.on_bound for end in ends):
            return True
    return False


def named_terms(fit: Fit, nominal: Document) -> tuple[int, ...]:
    """Places of the terms whose effect is at least at its level."""
    fitted = fit.hypothesis.written(fit.coordinates)
    terms, lesser = fit.hypothesis.terms, shorter_twin(fit)
    return tuple(i for i, term in enumerate(terms) if term.effect != lesser and _at_level(term.effect, nominal, fitted))


def shorter_twin(fit: Fit) -> str:
    """The shorter of a delay and a lag that are both in: together they are one drive that is late, of higher order."""
    if not {term.effect for term in fit.hypothesis.terms} >= set(TWINS):
        return ""
    fitted = fit.hypothesis.written(fit.coordinates)
    late, lag = get(fitted, "delay.additional_s"), get(fitted, "actuator_lag.time_constant_s")
    return "delay" if late < lag else "actuator_lag" if lag > 0.0 else ""  # a limited rate is no twin


def _at_level(effect: str, nominal: Document, fitted: Document) -> bool:
    """Whether an effect that is a level of the model's own parameters has left its band."""
    coulomb = get(nominal, "friction.coulomb")
    if effect == "inertia":
        return _factor(nominal, fitted, "inertia") >= 1.0 + RECALIBRATION
    if effect == "torque_offset":
        return abs(get(fitted, "torque_offset") - get(nominal, "torque_offset")) >= OFFSET_SHARE * coulomb
    if effect == "delay":
        return abs(get(fitted, "delay.additional_s") + get(fitted, "delay_s") - get(nominal, "delay_s")) >= DELAY_S
    if effect == "presliding" and get(nominal, "friction.sigma0") > 0.0 and "presliding" not in fitted:
        return max(_factor(nominal, fitted, f"friction.{key}") for key in ("sigma0", "sigma1")) >= BRISTLE_FACTOR
    if effect == "stribeck" and "stribeck" not in fitted:
        was, now = (get(d, "friction.static") - get(d, "friction.coulomb") for d in (nominal, fitted))
        return abs(now - was) >= STRIBECK_SHARE * coulomb
    if effect == "torque_gain":
        factors = [get(fitted, f"torque_gain.{key}", 1.0) for key in ("factor", "negative_factor")]
        return max(max(f, 1.0 / f) for f in factors) >= 1.0 + RECALIBRATION
    if effect == "torque_ripple":
        return _largest_wave(fitted, effect) >= SETTINGS.verdict.ripple_share
    return True


def _largest_wave(fitted: Document, effect: str) -> float:
    """Amplitude of the largest sine over position of an effect."""
    return max((float(row["amplitude"]) for row in fitted.get(effect, {}).get("harmonics", [])), default=0.0)


def _factor(nominal: Document, fitted: Document, key: str) -> float:
    was, now = get(nominal, key), get(fitted, key)
    return max(was, now) / min(was, now) if min(was, now) > 0.0 else 1.0
