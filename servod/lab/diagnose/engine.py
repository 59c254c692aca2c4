"""The whole diagnosis: recordings and a model in, verdict and evidence out.

Stands between the command line and everything else here; writes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from time import monotonic

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import taken_in
from servod.lab.diagnose.judge.conclude import conclude, extended_model, free_windows
from servod.lab.diagnose.judge.held_out import foretold, held_out, once, split
from servod.lab.diagnose.judge.judgement import Judgement
from servod.lab.diagnose.judge.locate import maps
from servod.lab.diagnose.judge.sorting import sorted_out
from servod.lab.diagnose.judge.spread import spread
from servod.lab.diagnose.judge.unnamed import unnamed
from servod.lab.diagnose.judge.verdict import drowned, named_terms, shares, verdict
from servod.lab.diagnose.predict.coordinates import units
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import Diagnosis, Verdict
from servod.lab.diagnose.select.choice import Choice
from servod.lab.diagnose.select.choose import Chooser
from servod.lab.diagnose.select.detail import detail, much_left, slow, swapped, tidied
from servod.lab.diagnose.select.fit import Weighing
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.recordings import Recording

Tell = Callable[[str], None]


def diagnose(
    model: AxisModel, recordings: Sequence[Recording], time_limit_s: float = 120.0, tell: Tell | None = None
) -> Diagnosis:
    """Diagnose `model` by `recordings`. `tell` is called with a line of progress now and then."""
    tell = tell or (lambda _line: None)
    begun = monotonic()
    traces, refused = taken_in(recordings, model)
    seconds = {"intake": monotonic() - begun}
    if not traces:
        return Diagnosis(units(model), tuple(refused), Verdict.CANNOT_TELL, None, seconds | {"windows": 0.0})
    tell(f"{len(traces)} recordings taken in")
    predictor = Predictor(traces, model)
    chooser = Chooser(predictor, model, begun + SETTINGS.forward.search_share * time_limit_s, tell)
    choice = chooser.run()
    swapped(chooser, choice)
    if much_left(chooser, choice):
        detail(chooser, choice)
        slow(chooser, choice)
    seconds["search"] = monotonic() - begun - seconds["intake"]
    choice.fit = tidied(chooser, choice.fit)
    chooser.lower_floor(choice.fit.mismatch)
    choice.floor = chooser.floor
    judgement = proved(predictor, chooser, choice, tell)
    while (worse := _worse_unseen(judgement)) is not None:
        choice.drop(worse, judgement.less[worse])
        judgement = proved(predictor, chooser, choice, tell)
    judgement = sorted_out(judgement, chooser)
    seconds["proof"] = monotonic() - begun - seconds["intake"] - seconds["search"]
    final = verdict(choice, judgement.named, judgement.errors, predictor.dry)
    if final is Verdict.MISSING_PHYSICS and _foretells_nothing(judgement):
        final = Verdict.UNEXPLAINED
    if final is Verdict.UNEXPLAINED:
        judgement = _without_names(judgement)
    untried = final is Verdict.UNEXPLAINED and choice.cut and choice.tried == 0
    if untried or drowned(final, predictor.encoder_noise, predictor.dry):
        final = Verdict.CANNOT_TELL
    judged = monotonic()
    extended = extended_model(judgement, model)
    free = free_windows(judgement, model, extended)
    seconds["windows"] = monotonic() - judged
    return Diagnosis(units(model), tuple(refused), final, conclude(judgement, model, extended, free), seconds)


def proved(predictor: Predictor, chooser: Chooser, choice: Choice, tell: Tell) -> Judgement:
    """A choice proved on rows that its fits have not seen; names are those of terms at the level of their effect."""
    fit = choice.fit
    nominal = chooser.start.document
    named = named_terms(choice, nominal)
    counts = predictor.counts
    tell("held-out recordings")
    less = {place: chooser.less(fit, place) for place in named}
    weighing = Weighing(chooser.fitter(fit.mismatch).weighing.scale, chooser.rows)
    shared = split(predictor, fit)
    before = held_out(predictor, choice.base, shared)
    after = held_out(predictor, fit, shared) if fit is not choice.base else before
    alone = len(named) == 1 and len(fit.hypothesis.terms) == 1
    without = {p: before if alone else held_out(predictor, f, shared) for p, f in less.items()}
    unseen = shares((before.mismatch, after.mismatch), counts, choice.floor)
    return Judgement(
        predictor=predictor,
        choice=choice,
        named=named,
        errors=shares((choice.base.mismatch, fit.mismatch), counts, choice.floor),
        spread=spread(fit, weighing, predictor.traces[0].period_s, after),
        less=less,
        shared=shared,
        unseen=unseen,
        before=before,
        after=after,
        without=without,
        unnamed=None,
        maps_before=maps(predictor, choice.base.mismatch),
        maps_after=maps(predictor, fit.mismatch),
        attempt=unseen.removed,
    )


def _worse_unseen(judgement: Judgement) -> int | None:
    """The named term without which unseen rows are foretold best, if better than with it; no event, which none are."""
    events = once(judgement.fit.hypothesis)
    others = {
        place: held.rms
        for place, held in judgement.without.items()
        if held.rms <= judgement.after.rms and place not in events
    }
    return min(others, key=lambda place: others[place]) if others else None


def _foretells_nothing(judgement: Judgement) -> bool:
    """Whether free windows are hardly better for the names, although something is left: terms that only fit.

    Names of events in one recording alone are not asked, since nobody can foretell them.
    """
    if (
        set(judgement.named) <= set(once(judgement.fit.hypothesis))
        or judgement.unseen.after < SETTINGS.validation.fitted_floors * judgement.unseen.floor
    ):
        return False
    judged = judgement.shared.judged
    return (
        foretold(judgement.predictor, judgement.before, judgement.after, judged)
        > SETTINGS.validation.most_free_run_error
    )


def _without_names(judgement: Judgement) -> Judgement:
    """The judgement when no name may stand: the base, and a table of what is left without a name."""
    choice, predictor = judgement.choice, judgement.predictor
    bare = replace(choice, fit=choice.base, merits=[], entries=[])
    left = unnamed(predictor, choice.base.mismatch)
    size = len(choice.base.coordinates)
    shared = split(predictor, choice.base)
    before = held_out(predictor, choice.base, shared)
    errors, unseen = (
        shares((rows, rows), predictor.counts, choice.floor) for rows in (choice.base.mismatch, before.mismatch)
    )
    return replace(
        judgement, choice=bare, named=[], kept={}, errors=errors, less={}, without={}, unnamed=left, shared=shared,
        before=before, after=before, unseen=unseen, spread=judgement.spread[:size, :size],
        maps_after=judgement.maps_before,
    )  # fmt: skip
