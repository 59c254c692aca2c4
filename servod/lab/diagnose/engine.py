"""The whole diagnosis: recordings and a model in, a finished result out.

Stands between the command line and everything else here; writes nothing. The stages, in their order: recordings are
loaded as traces, terms are selected (forward selection with backward elimination, swap, other forms, a group of small
terms, a drift, nominal values restored, cross-validation), what is selected is judged, and the result is concluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic

from servod.common.progress import OnLine
from servod.common.units import counted
from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.judge.conclude import (
    conclude,
    extended_model,
    free_windows,
    name_findings,
    reject_terms,
)
from servod.lab.diagnose.judge.free_run import judge_held_out
from servod.lab.diagnose.judge.judgement import (
    JudgedSelection,
    errors_of_names,
    judge,
    predicts_nothing,
    without_names,
)
from servod.lab.diagnose.judge.partial import model_without_names, partial_answer
from servod.lab.diagnose.judge.verdict import below_noise, verdict
from servod.lab.diagnose.predict.coordinates import units
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import Diagnosis, DiagnosisVerdict
from servod.lab.diagnose.select.cross_validation import cross_validate
from servod.lab.diagnose.select.drive import complete_drive
from servod.lab.diagnose.select.forms import better_forms
from servod.lab.diagnose.select.selection import Selection
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.select.stepwise import (
    above_floor,
    add_drift,
    add_group,
    forward_selection,
    restore_nominal,
    swap_terms,
)
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.recordings import Recording


def diagnose(
    model: AxisModel,
    recordings: Sequence[Recording],
    time_limit_s: float = 120.0,
    on_progress: OnLine | None = None,
    held_out: Sequence[Recording] = (),
) -> Diagnosis:
    """What `model` leaves out of the axis that the recordings are of.

    The search for terms ends after three quarters of `time_limit_s` with what it has; `on_progress` is called with
    a line of progress now and then. Recordings that cannot tell are refused with a reason each, and without any other
    there is no evidence. `held_out` are judged by what was found, and by nothing before. Computed on up to two cores.

        found = diagnose(load_axis_model(path), [load_recording(run) for run in runs])
        for effect in found.evidence.findings if found.evidence else (): print(effect.effect, effect.parameters)
    """
    on_progress = on_progress or (lambda _line: None)
    begun = monotonic()
    completed = complete_drive(model, recordings)
    model = completed.model
    traces, refused = load_traces(recordings, model)
    seconds = {"intake": monotonic() - begun}
    if not traces:
        return Diagnosis(units(model), tuple(refused), DiagnosisVerdict.CANNOT_TELL, None, seconds | {"windows": 0.0})
    on_progress(f"{counted(len(traces), 'recording')} taken in")
    deadline = begun + SETTINGS.forward.search_share * time_limit_s
    selector = Selector(Predictor(traces, model), model, deadline, on_progress, completed.unknown)
    selection = _selected(selector, selector.fit_base())
    seconds["search"] = monotonic() - begun - seconds["intake"]
    judgement = _judged(selector, selection)
    while (rest := reject_terms(selector, judgement)) is not None:
        judgement = _judged(selector, _selected(selector, rest))
    final, judgement = _verdict(judgement)
    seconds["proof"] = monotonic() - begun - seconds["intake"] - seconds["search"]
    if final is DiagnosisVerdict.UNEXPLAINED:
        (extended, free), part = model_without_names(judgement, model), partial_answer(judgement)
    else:
        extended, free, part = extended_model(judgement, model), free_windows(judgement, model), None
    judged = judge_held_out(model, extended, held_out)
    seconds["windows"] = monotonic() - begun - sum(seconds.values())
    return Diagnosis(units(model), tuple(refused), final, conclude(judgement, extended, free, part), seconds, judged)


def _selected(selector: Selector, selection: Selection) -> Selection:
    """The selection with all terms that are worth it, but those of effects that were rejected."""
    selection = swap_terms(selector, forward_selection(selector, selection))
    better = better_forms(selector, selection)
    if better is not selection:  # what another form had taken may be something else's
        selection = forward_selection(selector, better)
    if above_floor(selector, selection):
        selection = add_drift(selector, add_group(selector, selection))
    return selection


def _judged(selector: Selector, selection: Selection) -> JudgedSelection:
    """The selection cross-validated and judged, and which of its terms are findings."""
    finer = selector.finer(selection.fit.model)
    selection = cross_validate(finer, restore_nominal(finer, finer.refitted(selection)))
    return name_findings(finer, judge(finer, selection))


def _verdict(judgement: JudgedSelection) -> tuple[DiagnosisVerdict, JudgedSelection]:
    """The verdict, and the judgement without names where none may stand."""
    predictor, selection = judgement.predictor, judgement.selection
    driven = any(trace.drive.told is not None for trace in predictor.traces)
    found = verdict(judgement.named, errors_of_names(judgement), predictor.dry, driven=driven)
    if found is DiagnosisVerdict.MISSING_PHYSICS and predicts_nothing(judgement):
        found = DiagnosisVerdict.UNEXPLAINED
    if found is DiagnosisVerdict.UNEXPLAINED:
        judgement = without_names(judgement)
    untried = found is DiagnosisVerdict.UNEXPLAINED and selection.cut and selection.tried == 0
    if untried or below_noise(found, predictor.encoder_noise, predictor.dry):
        found = DiagnosisVerdict.CANNOT_TELL
    return found, judgement
