"""All fits in order, from recordings alone: what the walk does at its end, and `servoctl identify --from` by itself.

Above the fits, below the walk; never touches an axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from servod.common.errors import AnswerIsNo
from servod.lab.identify.estimate import Estimate
from servod.lab.identify.fits import break_away, bristle, curve, friction_map, kick, noise, presliding, response
from servod.lab.identify.fits.bristle import Bristle
from servod.lab.identify.trace import Kind, Trace

#: Bristle damping against the critical one of inertia on the bristle, taken where it is not measured.
ASSUMED_DAMPING = 0.5
#: Torque noise lets a joint break away early by so many standard deviations.
EARLY_BY = 2.0


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
    kicked = kick.fit(of_kind(traces, Kind.KICK))
    answer = response.fit(of_kind(traces, Kind.RESPONSE)[-1], kicked.inertia)
    delay_s = answer.delay_s.value + answer.lag_s.value
    damping = _damping(traces, answer, rocked)
    bristles = _bristle(slides, rocked, damping, answer.inertia.value)
    mapped = friction_map.fit(of_kind(traces, Kind.FRICTION_MAP), answer.inertia.value, delay_s, bristles)
    positive, negative = curve.fit(mapped.positive), curve.fit(mapped.negative)
    cogs = sum(wave.amplitude.value for wave in mapped.cogging)
    return Analysis(
        noise.fit(of_kind(traces, Kind.NOISE)[-1]),
        break_away.widened(slides, math.hypot(cogs, EARLY_BY * answer.torque_noise_rms.value)),
        rocked,
        kicked,
        answer,
        mapped,
        positive,
        negative,
        damping,
        tuple(trace.sha256 for trace in traces if trace.sha256),
    )


def assumed_damping(inertia: float, stiffness: float) -> float:
    """sigma1 where it is not measured: a share of the critical damping of inertia on the bristle."""
    return ASSUMED_DAMPING * 2.0 * math.sqrt(stiffness * inertia)


def _damping(
    traces: Sequence[Trace], answer: response.ResponseFit, rocked: presliding.PreslidingFit
) -> Estimate | None:
    """Bristle damping from the newest recording that shows it; None when there is none or it does not tell."""
    ringing = [trace for trace in traces if trace.kind == Kind.BRISTLE]
    if not ringing or answer.lag_s.value > 0.0:
        return None
    viscous = max(0.0, answer.viscous_slope.value)
    return bristle.fit(ringing[-1], answer.inertia.value, answer.delay_s.value, viscous, rocked.stiffness.value)


def _bristle(
    slides: break_away.BreakAwayFit, rocked: presliding.PreslidingFit, damping: Estimate | None, inertia: float
) -> Bristle:
    """What the map must know of the bristles."""
    stiffness = rocked.stiffness.value
    measured = damping.value if damping is not None else assumed_damping(inertia, stiffness)
    return Bristle(stiffness, measured, 0.5 * (slides.positive.value + slides.negative.value))
