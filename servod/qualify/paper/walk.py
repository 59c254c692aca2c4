"""The whole of `servoctl qualify paper`: identify, design, track, sweep, draw, in as little time as the cores allow.

Above everything of `paper`; its jobs go to the pool, what they found is gathered here.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from servod.common.portable import usable_cores
from servod.common.progress import OnProgress
from servod.common.workers import worker_pool
from servod.formats.gains.gain_set import GainSet
from servod.lab.report.figure import Figure
from servod.lab.report.figures.sets import local_law
from servod.lab.report.pictures import write_pictures
from servod.lab.tune.plan import Feedback
from servod.qualify.paper import document, equations, experiments, motions, open_questions, programme, sweeps
from servod.qualify.paper.experiments import Contender, Found, Measured, cutoff_of
from servod.qualify.paper.joints import PaperJoint, at_paper_feedback, printed_l, shipped_set, with_l, without_observer
from servod.qualify.paper.printed import FRICTION
from servod.qualify.paper.results import Results, Row

# --- Work on several processes ---------------------------------------------------------------------------------------
# Work on several processes: jobs with a weight each, progress by what is done, and a clean end at Ctrl-C. The processes
# are those of servod.common.workers. Jobs are plain functions on plain values; a worker never leaves files that count.


P = ParamSpec("P")
T = TypeVar("T")


MOST_WORKERS = 4
_POLL_S = 0.05


class JobPool:
    """Worker processes, one for each core and at least two; leaving the block ends them at once."""

    def __init__(self, on_progress: OnProgress, expected_s: float) -> None:
        """`expected_s`: sum of the weights of all jobs that will come, in seconds of one core."""
        self._on_progress, self._expected_s, self._done_s = on_progress, expected_s, 0.0
        self._stack = ExitStack()
        self._open: dict[Future[Any], tuple[str, float]] = {}

    def __enter__(self) -> JobPool:
        workers = min(MOST_WORKERS, max(2, usable_cores()))
        self._pool = self._stack.enter_context(worker_pool(workers))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def submit(self, what: str, weight_s: float, job: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Begin `job` as soon as a worker is free; `weight_s` is its share of the progress."""
        pending = self._pool.submit(job, *args, **kwargs)
        self._open[pending] = (what, weight_s)
        return pending

    def result(self, pending: Future[T]) -> T:
        """The result of one job; others that end meanwhile count as progress. Raises what a job raised, at once."""
        while pending in self._open:
            ended = [job for job in self._open if job.done()]
            for job in ended:
                self._count(job)
            if not ended:
                time.sleep(_POLL_S)
        return pending.result()

    def _count(self, ended: Future[Any]) -> None:
        what, weight_s = self._open.pop(ended)
        ended.result()  # a failure of any job ends the walk, not only of the one that is waited for
        self._done_s += weight_s
        self._on_progress(what, min(1.0, self._done_s / self._expected_s))


#: l_i of the local law at the paper's PD gains without observer, in all its sets; as the demo's plain set.
PLAIN_L = 0.1
#: RMS of the noise on friction in Fig. 11 and 12, as a share of F_C.
NOISE_SHARE = 0.1
#: What tuning the rivals of one law takes, and scoring one in one class, in seconds of one core.
_TUNE_S, _SCORE_S = 18.0, 3.0
#: Shipped sets by row.
_SHIPPED = {
    Row.PD: "paper_pd",
    Row.DOB: "paper_pd_dob",
    Row.LUGRE: "paper_pd_lugre",
    Row.LUGRE_BETTER: "paper_pd_lugre_lf025",
    Row.LUGRE_OSCILLATES: "paper_pd_lugre_lf035",
    Row.TABLE1: "table1_kz_kv_kx",
    Row.TABLE1_OTHER: "table1_kx_kv_kz",
}


@dataclass(frozen=True)
class PaperPlan:
    """How much is done. `identify` False takes the plants' own models, which leaves out Fig. 7 and 8."""

    seed: int = 1
    joints: tuple[PaperJoint, ...] = (PaperJoint.TABLE1, PaperJoint.REAL)
    seconds: float = 30.0
    hold_s: float = 3.0
    identify: bool = True
    factors: tuple[float, ...] = sweeps.FACTORS
    pictures: bool = True
    tune: tuple[PaperJoint, ...] = (PaperJoint.REAL,)


#: A look at everything that needs no identification, on Table I's joint alone.
QUICK = PaperPlan(
    joints=(PaperJoint.TABLE1,),
    seconds=4.0,
    hold_s=1.2,
    identify=False,
    factors=(0.01, 0.1, 1.0),
    pictures=False,
    tune=(),
)


def paper(plan: PaperPlan, out: Path, on_progress: OnProgress) -> dict[str, Any]:
    """Do the paper into the folder `out` and return its document. Raises BadInput and AnswerIsNo."""
    started = time.monotonic()
    with JobPool(on_progress, expected_s(plan)) as pool:
        results = gather(plan, pool)
        figures = document.shown(results)
        if plan.pictures:
            drawn = [pool.submit(f"{s.figure.name}", 1.5, draw, s.figure, out / document.PICTURES) for s in figures]
            for picture in drawn:
                pool.result(picture)
    found = document.document(results, figures, time.monotonic() - started)
    document.write(out, figures, found)
    return found


def expected_s(plan: PaperPlan) -> float:
    """Sum of all weights below, for the progress."""
    tracked = len(Row) * len(plan.joints) * _track_s(plan)
    drawn = 1.5 * (14 + 8 * len(plan.joints)) if plan.pictures else 0.0
    tuned = len(plan.tune) * (len(experiments.FAMILIES) * _TUNE_S + len(experiments.LABELS) * 2.0 * _SCORE_S)
    return tracked + drawn + tuned + (45.0 if plan.identify else 6.0) * len(plan.joints) + 20.0


def _track_s(plan: PaperPlan) -> float:
    return 0.12 * (plan.seconds + 2.0 * plan.hold_s)


def draw(figure: Figure, folder: Path) -> None:
    """One figure as pictures: a job of the pool."""
    write_pictures(figure, folder)


def gather(plan: PaperPlan, pool: JobPool) -> Results:
    """Everything that is run; what needs an identification waits for it, all else goes on meanwhile."""
    found = {joint: _found(plan, pool, joint) for joint in plan.joints}
    tracked = {key: job for joint in plan.joints for key, job in _track_shipped(plan, pool, joint)}
    swept = _sweep(plan, pool)
    noise = pool.submit(
        "noise on friction", 3.0, sweeps.under_noise, _noise_sets(), FRICTION.coulomb, plan.seconds, plan.seed
    )
    slips = {
        open_questions.EXPONENT: pool.submit("(18)", 1.0, equations.exponent_of_18, plan.seconds),
        open_questions.LITERAL_8: pool.submit("(8)", 1.0, equations.literal_8, plan.seconds),
    }
    solved = pool.submit("(12) to (15)", 3.0, programme.answers, plan.seconds)
    sines = _sines(plan, pool)
    designed = {joint: pool.result(job) for joint, job in found.items()}
    tracked |= {key: job for joint, it in designed.items() for key, job in _track_found(plan, pool, joint, it)}
    return Results(
        plan.seed,
        plan.seconds,
        designed,
        {key: pool.result(job) for key, job in tracked.items()},
        {name: pool.result(job) for name, job in sines.items()},
        {name: pool.result(job) for name, job in swept.items()},
        pool.result(noise),
        {name: pool.result(job) for name, job in slips.items()},
        pool.result(solved),
        {joint: _contenders(plan, pool, joint, designed[joint]) for joint in plan.tune if joint in designed},
    )


def _found(plan: PaperPlan, pool: JobPool, joint: PaperJoint) -> Future[Found]:
    if plan.identify:
        return pool.submit(f"{joint.label} identified", 45.0, experiments.identify_and_design, joint, plan.seed)
    return pool.submit(f"{joint.label} designed for", 6.0, experiments.design_for_model, joint)


def _contenders(plan: PaperPlan, pool: JobPool, joint: PaperJoint, found: Found) -> list[Contender]:
    """Every rival tuned on what was found of the joint, each scored as soon as its law is done."""
    cutoff_hz = cutoff_of(found.gains)
    tuned = [
        pool.submit(f"{names[0]} tuned", _TUNE_S, experiments.tuned_sets, found.model, names, cutoff_hz, plan.seed)
        for names in experiments.FAMILIES
    ]
    scored = {
        (feedback, name): pool.submit(
            f"{name} scored",
            _SCORE_S,
            experiments.score_rival,
            joint,
            name,
            feedback,
            gains,
            cutoff_hz,
            plan.seed,
            plan.seconds,
        )
        for job in tuned
        for (feedback, name), gains in pool.result(job).items()
    }
    return [pool.result(scored[feedback, name]) for feedback in Feedback for name in experiments.LABELS]


Tracked = tuple[tuple[PaperJoint, Row], Future[Measured]]


def _track_shipped(plan: PaperPlan, pool: JobPool, joint: PaperJoint) -> Iterator[Tracked]:
    """The paper's sets in all readings."""
    yield from _track(plan, pool, joint, paper_sets())


def paper_sets() -> dict[Row, GainSet]:
    """The shipped sets of the paper in all readings, by their rows."""
    sets = {row: shipped_set(name) for row, name in _SHIPPED.items()}
    return sets | {Row.TABLE1_PRINTED_L: printed_l(sets[Row.TABLE1])}


def _track_found(plan: PaperPlan, pool: JobPool, joint: PaperJoint, found: Found) -> Iterator[Tracked]:
    """The identified joint's sets."""
    yield from _track(plan, pool, joint, designed_sets(found.gains), cutoff_of(found.gains))


def designed_sets(gains: GainSet) -> dict[Row, GainSet]:
    """A synthesized set at the paper's feedback, without observer and with it, and as it is, by their rows."""
    equal = at_paper_feedback(gains, "equal")
    plain = without_observer(equal, "plain")
    plain = with_l(plain, "plain", [PLAIN_L] * len(local_law(plain).friction.sets))
    return {Row.LOCAL_PLAIN: plain, Row.LOCAL_EQUAL: equal, Row.DEPLOYED: gains}


def _track(
    plan: PaperPlan, pool: JobPool, joint: PaperJoint, sets: dict[Row, GainSet], cutoff_hz: float | None = None
) -> Iterator[Tracked]:
    for row, gains in sets.items():
        what = f"{row.label} on {joint.label}"
        settings = (cutoff_hz or cutoff_of(gains), plan.seed, plan.seconds, plan.hold_s)
        yield (joint, row), pool.submit(what, _track_s(plan), experiments.measure, joint, row.label, gains, *settings)


def _sweep(plan: PaperPlan, pool: JobPool) -> dict[str, Future[sweeps.SweepOfL]]:
    table1 = shipped_set("table1_kz_kv_kx")
    bases = {open_questions.TABLE1_GAINS: table1, open_questions.PD_GAINS: at_paper_feedback(table1, "pd_gains")}
    return {
        name: pool.submit(f"l with {name}", 3.0, sweeps.sweep_of_l, gains, plan.seconds, plan.factors)
        for name, gains in bases.items()
    }


def _noise_sets() -> dict[str, GainSet]:
    return {row.label: shipped_set(_SHIPPED[row]) for row in (Row.DOB, Row.LUGRE, Row.LUGRE_BETTER, Row.TABLE1)}


def _sines(plan: PaperPlan, pool: JobPool) -> dict[str, Future[Any]]:
    """Fig. 9 to 12."""
    table1, pd = shipped_set("table1_kz_kv_kx"), shipped_set("paper_pd")
    noise_nm = NOISE_SHARE * FRICTION.coulomb
    disturbed = motions.DISTURBED
    return {
        motions.PROPOSED: pool.submit("Fig. 9", 0.5, sweeps.on_sine, motions.PROPOSED, table1, plan.seconds),
        motions.PD: pool.submit("Fig. 10", 0.5, sweeps.on_sine, motions.PD, pd, plan.seconds),
        disturbed: pool.submit("Fig. 11", 0.5, sweeps.on_sine, disturbed, table1, plan.seconds, noise_nm, plan.seed),
    }
