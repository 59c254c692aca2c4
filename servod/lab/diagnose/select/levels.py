"""Levels and ranges: when a parameter of the model's own is a finding, and when a fit leans on the end of a range.

Stands between the fit and the stages of the selection. Parameters with a level, pulled beyond it, are findings however
little they move: a softer bristle or a steeper Stribeck curve acts for some milliseconds behind each reversal and is
nothing on average. What came back under its level is recalibration.
"""

from __future__ import annotations

from servod.lab.diagnose.effects import effect, effects
from servod.lab.diagnose.effects.base import LEVELS
from servod.lab.diagnose.effects.hypothesis import PLAINER_FACTOR, Document, Term, get
from servod.lab.diagnose.select.fit import Fit, on_bound
from servod.lab.diagnose.settings import SETTINGS

#: Own numbers of such terms that have no level: damping that fades with speed is judged by the torque that it makes.
NO_LEVEL = frozenset(("damping_velocity",))


def level_at_bound(fit: Fit) -> bool:
    """Whether a parameter with a level stands on its bound: the data pull it further."""
    return bool(_levels_at_bound(fit))


def _levels_at_bound(fit: Fit) -> set[str]:
    """Keys of the parameters with a level that stand on their bound.

    The Stribeck velocity has none; it opens together with static friction.
    """
    watched = LEVELS - {"friction.stribeck_velocity"}
    base = zip(fit.hypothesis.base, on_bound(fit), strict=False)
    return {unknown.key for unknown, on in base if on and unknown.key in watched}


def releases_level(fit: Fit, term: Term) -> bool:
    """Whether a term opens the bound that a parameter with a level stands on in this fit."""
    return not _levels_at_bound(fit).isdisjoint(term.opens)


def is_level_change(term: Term) -> bool:
    """Whether a term opens parameters that have a level, and no others."""
    own = {unknown.key for unknown in term.unknowns}
    return bool(term.opens) and LEVELS.issuperset(term.opens) and not own & NO_LEVEL


#: Numbers that may lie at an end of their range: where they do not matter, or are known beforehand to a narrow one.
#: A bristle's damping is one of them, the model's own as well as that of a bristle that the model does not have; where
#: a spring rests is another: far beyond the travel it pulls with a constant force and a slope.
MAY_END = frozenset(
    (
        *("damping", "cubic", "exponent", "delay_s", "sigma1", "friction.sigma1"),
        *("friction.stribeck_velocity", "damping_velocity", "shift", "behind"),
    )
)


def at_end_of_range(fit: Fit, term_index: int = -1) -> bool:
    """Whether a number of a term (the last), or one of the model's own that it opens, lies at an end of its range.

    Then the effect says itself that it is something else: ranges are wide, and an optimum at an end, twenty times the
    mass or ten times the friction at rest, borrows a shape from an effect that is not there. An end where the number is
    zero is none: there the effect is just absent.
    """
    term, unknowns = fit.hypothesis.terms[term_index], fit.hypothesis.unknowns
    low, high = fit.hypothesis.bounds
    share = fit.hypothesis.share(term_index)
    for index, (unknown, at) in enumerate(zip(unknowns, fit.coordinates, strict=True)):
        own = share.start <= index < share.stop or unknown.key in term.opens
        if not own or unknown.key in MAY_END:
            continue
        ends = [end for end, value in ((low[index], unknown.low), (high[index], unknown.high)) if value != 0.0]
        if any(abs(float(at) - float(end)) < SETTINGS.worth.on_bound for end in ends):
            return True
    return False


def is_another(fit: Fit, index: int = -1) -> bool:
    """Whether a term says itself that it is something else.

    It lies at an end of its range, or is short of its own level and has a factor that a plainer effect is alone.
    """
    terms, index = fit.hypothesis.terms, index % len(fit.hypothesis.terms)
    plainer = any(terms[index].effect in one.within for one in effects())
    levelled = any(unknown.key == PLAINER_FACTOR for unknown in terms[index].unknowns)
    short = plainer and levelled and index not in named_terms(fit, fit.hypothesis.document)
    return short or at_end_of_range(fit, index)


def named_terms(fit: Fit, nominal: Document) -> tuple[int, ...]:
    """Places of the terms whose effect is at least at its level."""
    fitted = fit.hypothesis.written(fit.coordinates)
    terms, lesser = fit.hypothesis.terms, shorter_twin(fit)
    return tuple(
        i for i, term in enumerate(terms) if term.effect != lesser and effect(term.effect).at_level(nominal, fitted)
    )


def shorter_twin(fit: Fit) -> str:
    """The shorter of a delay and a lag that are both in: together they are one drive that is late, of higher order."""
    there = {term.effect for term in fit.hypothesis.terms}
    pairs = [(found, effect(found.twin)) for found in effects() if found.name in there and found.twin in there]
    if not pairs:
        return ""
    fitted, (one, other) = fit.hypothesis.written(fit.coordinates), pairs[0]
    late, later = get(fitted, one.lateness), get(fitted, other.lateness)
    return one.name if late < later else other.name if later > 0.0 else ""  # a limited rate is no twin
