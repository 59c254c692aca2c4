"""What is handed out where no name may stand: part of an answer, and the model that predicts unseen rows best.

Stands between the judgement and the result. Known physics that carries most of a mismatch is worth saying though
something is left beside it; it is no finding, for what is left may change it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.judge.conclude import extended_model, free_windows, parameters
from servod.lab.diagnose.judge.judgement import JudgedSelection
from servod.lab.diagnose.result import PartialAnswer, PartialEffect, Windows
from servod.lab.diagnose.settings import SETTINGS

#: A model and the errors of its free windows.
Answer = tuple[AxisModel, tuple[Windows, ...]]


def partial_answer(judgement: JudgedSelection) -> PartialAnswer | None:
    """Effects each of which removes a good share of the error on unseen rows; None where none does."""
    whole = judgement.partial
    if whole is None:
        return None
    terms = whole.fit.hypothesis.terms
    found = []
    for name in dict.fromkeys(terms[index].effect for index in whole.named):
        terms_of_effect = [index for index in whole.named if terms[index].effect == name]
        share = min(sum(whole.removed_share(index) for index in terms_of_effect), whole.removed_by_known)
        if share >= SETTINGS.verdict.least_partial:
            found.append(PartialEffect(name, share, parameters(whole, terms_of_effect)))
    return PartialAnswer(tuple(found), whole.removed_by_known, whole.maps_after[0].coordinate) if found else None


def model_without_names(judgement: JudgedSelection, nominal: AxisModel) -> Answer:
    """The best of the model with a table of what is left, that with part of the answer, and the model as it came."""
    whole = judgement.partial
    some = [judgement] if whole is None else [judgement, whole]
    return best_model(nominal, [(extended_model(one, nominal), free_windows(one, nominal)) for one in some])


def best_model(nominal: AxisModel, answers: Sequence[Answer]) -> Answer:
    """The answer whose free windows are off least; the model as it came where none is better in every length."""
    better = [answer for answer in answers if all(w.errors.after <= w.errors.before for w in answer[1])]
    if not better:
        return nominal, tuple(_as_it_came(window) for window in answers[0][1])
    return min(better, key=lambda answer: math.prod(w.errors.after / max(w.errors.before, 1e-30) for w in answer[1]))


def _as_it_came(window: Windows) -> Windows:
    each = {name: replace(run, after=run.before) for name, run in window.recordings.items()}
    errors = replace(window.errors, after=window.errors.before)
    return replace(window, errors=errors, recordings=each, after=window.before)
