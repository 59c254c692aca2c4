"""Whether a fitted effect says itself that it is something else: one of its own numbers lies at an end of its range.

Stands between the fit and the selection. Ranges are wide, what is physical lies within: an optimum at an end, twenty
times the mass or ten times the friction at rest, borrows a shape from an effect that is not there.
"""

from __future__ import annotations

from servod.lab.diagnose.select.fit import Fit

#: Numbers that may lie at an end of their range: where they do not matter, or are known beforehand to a narrow one.
#: A bristle's damping is one of them, the model's own as well as that of a bristle that the model does not have.
MAY_END = frozenset(
    (
        *("damping", "cubic", "exponent", "delay_s", "sigma1", "friction.sigma1"),
        *("friction.stribeck_velocity", "damping_velocity"),
    )
)

#: Coordinates that are so close to an end lie on it.
CLOSE = 1e-6


def at_end(fit: Fit, place: int = -1) -> bool:
    """Whether a number of a term (the last), or one of the model's own that it opens, lies at an end of its range.

    An end where the number is zero is none: there the effect is just absent.
    """
    term, unknowns = fit.hypothesis.terms[place], fit.hypothesis.unknowns
    low, high = fit.hypothesis.bounds
    share = fit.hypothesis.share(place)
    for index, (unknown, at) in enumerate(zip(unknowns, fit.coordinates, strict=True)):
        own = share.start <= index < share.stop or unknown.key in term.opens
        if not own or unknown.key in MAY_END:
            continue
        ends = [end for end, value in ((low[index], unknown.low), (high[index], unknown.high)) if value != 0.0]
        if any(abs(float(at) - float(end)) < CLOSE for end in ends):
            return True
    return False
