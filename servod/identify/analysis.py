"""All fits in order, from recordings alone: what the walk does at its end, and `servoctl identify --from` by itself.

Above the fits, below the walk; never touches an axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from servod.errors import AnswerIsNo
from servod.identify.estimate import Estimate
from servod.identify.fits import break_away, bristle, curve, friction_map, kick, noise, presliding, response
from servod.identify.trace import Kind, Trace


@dataclass(frozen=True)
class Analysis:
    """Every fit of one identification."""

    noise: noise.NoiseFit
    break_away: break_away.BreakAwayFit
    presliding: presliding.PreslidingFit
    kick: kick.KickFit
    response: response.ResponseFit
    map: friction_map.MapFit
    positive: curve.CurveFit
    negative: curve.CurveFit
    damping: Estimate | None
    data_sha256: tuple[str, ...]  # of the recordings' files

    @property
    def break_away_rad(self) -> float:
        """Way of the bristles until the joint slides: static friction over stiffness."""
        return break_away_rad(self.break_away, self.presliding)


def break_away_rad(slides: break_away.BreakAwayFit, rocked: presliding.PreslidingFit) -> float:
    """Mean static friction over stiffness."""
    return 0.5 * (slides.positive.value + slides.negative.value) / rocked.stiffness.value


def of_kind(traces: Sequence[Trace], kind: Kind) -> list[Trace]:
    """The recordings of one experiment. Raises AnswerIsNo when there is none."""
    found = [trace for trace in traces if trace.kind == kind]
    if not found:
        raise AnswerIsNo(f"no recording of the experiment {kind.value}; run it first")
    return found


def analyse(traces: Sequence[Trace]) -> Analysis:
    """Fit everything. Raises AnswerIsNo where an experiment is missing or tells nothing."""
    ramps = of_kind(traces, Kind.BREAK_AWAY)
    slides = break_away.fit([ramp for ramp in ramps if not ramp.settings["search"]] or ramps)
    rocked = presliding.fit(of_kind(traces, Kind.PRESLIDING), slides)
    kicked = kick.fit(of_kind(traces, Kind.KICK)[-2:])
    answer = response.fit(of_kind(traces, Kind.RESPONSE)[-1], kicked.inertia)
    delay_s = answer.delay_s.value + answer.lag_s.value
    way = break_away_rad(slides, rocked)
    mapped = friction_map.fit(of_kind(traces, Kind.FRICTION_MAP), answer.inertia.value, delay_s, way)
    positive, negative = curve.fit(mapped.positive), curve.fit(mapped.negative)
    return Analysis(
        noise.fit(of_kind(traces, Kind.NOISE)[-1]),
        slides,
        rocked,
        kicked,
        answer,
        mapped,
        positive,
        negative,
        _damping(traces, answer, rocked, 0.5 * (positive.viscous.value + negative.viscous.value)),
        tuple(trace.sha256 for trace in traces if trace.sha256),
    )


def _damping(
    traces: Sequence[Trace], answer: response.ResponseFit, rocked: presliding.PreslidingFit, viscous: float
) -> Estimate | None:
    """Bristle damping from the newest recording that shows it; None when there is none or it does not tell."""
    ringing = [trace for trace in traces if trace.kind == Kind.BRISTLE]
    if not ringing or answer.lag_s.value > 0.0:
        return None
    return bristle.fit(ringing[-1], answer.inertia.value, answer.delay_s.value, viscous, rocked.stiffness.value)
