"""Fig. 9 to 12 and 15 to 18: the motions, and what the paper says of them.

Stands on the runs of the virtual axis: SYNC-stepped where the paper measured, simulated where the paper simulated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from servod.lab.report.figure import Array
from servod.lab.report.figures.motion import (
    SETTLE_S,
    PlottedMotion,
    disturbed_friction,
    errors,
    position_and_friction,
    steps,
    tracking,
    tracking_grid,
)
from servod.lab.tracking.metrics import StepResponse
from servod.qualify.paper.claims import Claim, Shown, ordered
from servod.qualify.paper.joints import PaperJoint
from servod.qualify.paper.printed import FRICTION, STEPS_MRAD
from servod.qualify.paper.results import Results, Row
from servod.qualify.paper.sweeps import NOISE_SHARES

#: Names of the motions in Results.sines.
PROPOSED, PD, DISTURBED = "Table I as (K_z, K_v, K_x)", "PD", "the same, friction disturbed"
#: Errors that differ by more than this factor count as a net improvement.
NET = 2.0
#: A steady error beyond this share of the step can be seen in the paper's figures.
STEADY_SHARE = 0.01
#: Where the torque of a step is searched for oscillation: after its jump, before it rests [s].
SWING_S = (0.1, 0.4)
#: A torque that swings by more than this, half of F_S from peak to peak, oscillates [N*m].
OSCILLATES_NM = 0.5 * FRICTION.static
#: Reference velocities around zero [rad/s]: a third of the peak of (19).
SLOW_RAD_S = 0.02
_COLUMNS = (Row.DOB, Row.LUGRE_BETTER, Row.TABLE1, Row.DEPLOYED)


def figures(results: Results) -> Iterator[Shown]:
    """All of them, in the paper's order; where both joints were run, those of section V for each."""
    yield from _simulated(results)
    for joint in results.found:
        yield from _measured(results, joint)


def _simulated(results: Results) -> Iterator[Shown]:
    proposed, pd, disturbed = (results.sines[name] for name in (PROPOSED, PD, DISTURBED))
    title = "{}: position, control signal and friction (simulated)"
    ratio = pd.rms_mrad() / proposed.rms_mrad()
    here = f"{pd.rms_mrad():.4g} mrad RMS under PD, {proposed.rms_mrad():.4g} proposed, a factor of {ratio:.3g}"
    net = Claim("a net improvement of the proposed law over PD on a slow sine", here, ratio > NET)
    yield Shown("9", position_and_friction([proposed], "figure_09_proposed", title.format("Proposed law")), (net,))
    stuck = Claim(
        "PD alone stands still at the reversals",
        f"it keeps its place for {_standing(pd):.0%} of the time",
        _standing(pd) > 2.0 * _standing(proposed),
    )
    yield Shown("10", position_and_friction([pd], "figure_10_pd", title.format("PD")), (stuck,))
    both = f"{proposed.rms_mrad():.4g} mrad RMS without, {disturbed.rms_mrad():.4g} mrad with the disturbance"
    stands = Claim("so does its error on a slow sine", both, disturbed.rms_mrad() < NET * proposed.rms_mrad())
    disturbance = disturbed_friction(proposed, disturbed, "figure_11_12_disturbed")
    yield Shown("11, 12", disturbance, (_robust(results), stands))


def _standing(motion: PlottedMotion) -> float:
    """Share of the cycles in which the joint moves slower than a twentieth of its mean speed."""
    speed = np.abs(np.diff(motion.position_rad))
    return float(np.mean(speed < 0.05 * np.mean(speed)))


def _robust(results: Results) -> Claim:
    """The proposed law against its own error without noise."""
    own = results.noise[Row.TABLE1.label]
    shares = ", ".join(f"{share:.0%}" for share in NOISE_SHARES)
    errors_mrad = ", ".join(f"{rms:.4g}" for rms in own)
    here = f"{errors_mrad} mrad RMS on (19) with noise of 0, {shares} of F_C"
    return Claim("the proposed law stands friction that leaves its nominal level", here, own[-1] < NET * own[0])


def _measured(results: Results, joint: PaperJoint) -> Iterator[Shown]:
    by_row = {row: results.measured[joint, row] for row in Row}
    tail, where = joint.value, f" ({joint.label})"
    pd = by_row[Row.PD].followed
    if pd is not None:
        figure = tracking(pd, f"figure_15_pd_{tail}", "Tracking (19) under PD" + where)
        yield Shown("15", figure, (_large_error(results, joint),), joint.label)
    for number, size, rows in (
        ("16", 100.0, (Row.PD, Row.LUGRE_OSCILLATES, Row.TABLE1, Row.DEPLOYED)),
        ("17", 10.0, (Row.LUGRE_OSCILLATES, Row.LUGRE_BETTER, Row.TABLE1, Row.DEPLOYED)),
    ):
        motions = [by_row[row].steps[size] for row in rows if size in by_row[row].steps]
        title = f"Steps of {size:g} mrad" + where
        claims = _step_claims(results, joint, size)
        yield Shown(number, steps(motions, f"figure_{number}_steps_{tail}", title), claims, joint.label)
    columns = {row: m for row in _COLUMNS if (m := by_row[row].followed) is not None}
    if not columns:
        return
    shown = list(columns.values())
    grid = tracking_grid(shown, f"figure_18_tracking_{tail}", "Tracking (19)" + where)
    yield Shown("18", grid, _order(results, joint), joint.label)
    drawn = errors(shown, f"figure_18_errors_{tail}", "Tracking errors on (19)" + where)
    yield Shown("18", drawn, (around_zero(columns[Row.DOB]),) if Row.DOB in columns else (), joint.label)


def around_zero(motion: PlottedMotion) -> Claim:
    """The observer's error where the reference is slow, against the rest; without the first second."""
    period_s = float(motion.time_s[1] - motion.time_s[0])
    speed = np.abs(np.gradient(motion.reference_rad, period_s))
    scored = motion.time_s >= SETTLE_S
    slow, rest = (_rms(motion.error_mrad[scored & part]) for part in (speed < SLOW_RAD_S, speed >= SLOW_RAD_S))
    here = f"{slow:.4g} mrad RMS where the reference is slower than {SLOW_RAD_S:g} rad/s, {rest:.4g} elsewhere"
    return Claim("the disturbance observer shows limitations around zero velocity", here, slow > NET * rest)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _large_error(results: Results, joint: PaperJoint) -> Claim:
    pd, proposed = results.rms(joint, Row.PD), results.rms(joint, Row.TABLE1)
    if pd is None or proposed is None:
        return Claim("PD alone has large tracking errors", "an axis stopped", False)
    return Claim(
        "PD alone has large tracking errors",
        f"{pd:.4g} mrad RMS against {proposed:.4g} of the proposed law",
        pd > 10.0 * proposed,
    )


def _response(results: Results, joint: PaperJoint, row: Row, size: float) -> StepResponse | None:
    return results.measured[joint, row].responses.get(size)


def _step_text(results: Results, joint: PaperJoint, row: Row, size: float) -> str:
    """One step in words."""
    found = _response(results, joint, row, size)
    if found is None:
        return f"{row.label} stops the axis ({results.measured[joint, row].stops.get(f'{size:g} mrad', 'not run')})"
    settled = "does not settle" if found.settling_s is None else f"settles in {1e3 * found.settling_s:.0f} ms"
    swing = ", a limit cycle" if found.limit_cycle else ""
    steady = f"steady error {found.steady_error_mrad:.3g} mrad{swing}"
    swing_mnm = 1e3 * _torque_swing(results.measured[joint, row].steps[size])
    return f"{row.label} {settled}, overshoot {found.overshoot:.1%}, {steady}, torque swinging by {swing_mnm:.2g} mN·m"


def _torque_swing(motion: PlottedMotion) -> float:
    """Peak to peak of the torque within SWING_S, its slow course taken off [N*m]."""
    from_s, to_s = SWING_S
    part = motion.part(from_s, to_s)
    trend = np.polyval(np.polyfit(part.time_s, part.torque_nm, 3), part.time_s)
    return float(np.ptp(part.torque_nm - trend))


def _faster(results: Results, joint: PaperJoint, size: float, better: Row, worse: Row, paper: str) -> Claim:
    """Whether `better` settles sooner than `worse`, and settles at all."""
    one, other = (_response(results, joint, row, size) for row in (better, worse))
    here = "; ".join(_step_text(results, joint, row, size) for row in (better, worse))
    if one is None or one.settling_s is None:
        return Claim(paper, here, False)
    return Claim(paper, here, other is None or other.settling_s is None or one.settling_s < other.settling_s)


def _step_claims(results: Results, joint: PaperJoint, size: float) -> tuple[Claim, ...]:
    ours = "the local law, synthesized here, is faster than PD + LuGre"
    mine = _faster(results, joint, size, Row.DEPLOYED, Row.LUGRE_BETTER, ours)
    if size == STEPS_MRAD[0]:
        pd = _response(results, joint, Row.PD, size)
        left = pd is not None and pd.steady_error_mrad > STEADY_SHARE * size
        steady = Claim("PD alone leaves a steady-state error", _step_text(results, joint, Row.PD, size), left)
        said = "the proposed law is slightly faster than PD + LuGre"
        return steady, _faster(results, joint, size, Row.TABLE1, Row.LUGRE_OSCILLATES, said), mine
    still = _faster(results, joint, size, Row.TABLE1, Row.LUGRE_BETTER, "the proposed law does better still")
    return *_oscillation(results, joint, size), still, mine


def _oscillation(results: Results, joint: PaperJoint, size: float) -> tuple[Claim, Claim]:
    """Both l_f, by how far the torque swings once the step is over."""
    steps = results.measured[joint, Row.LUGRE_OSCILLATES].steps, results.measured[joint, Row.LUGRE_BETTER].steps
    high, low = (_torque_swing(found[size]) if size in found else math.inf for found in steps)
    first = _step_text(results, joint, Row.LUGRE_OSCILLATES, size)
    return (
        Claim("l_f = 0.35 oscillates at 10 mrad", first, high > OSCILLATES_NM),
        Claim("l_f = 0.25 does better", f"{first}; {_step_text(results, joint, Row.LUGRE_BETTER, size)}", low < high),
    )


def _order(results: Results, joint: PaperJoint) -> tuple[Claim, ...]:
    """The paper's order of RMS errors, with its own gains and with ours at its feedback."""
    said = "the errors fall from PD + DOB to PD + LuGre to the proposed law (0.6916, 0.5006, 0.3781)"
    claims = []
    for local, who in (
        (Row.TABLE1, ""),
        (Row.LOCAL_PLAIN, ", the local law at the same PD gains, no observer, measured velocity"),
        (Row.DEPLOYED, ", with the synthesized law"),
    ):
        rows: Sequence[Row] = (Row.DOB, Row.LUGRE_BETTER, local)
        scores = [(row.label, results.rms(joint, row)) for row in rows]
        known = [(label, rms) for label, rms in scores if rms is not None]
        if len(known) < len(rows):
            stopped = ", ".join(label for label, rms in scores if rms is None)
            claims.append(Claim(said + who, f"the axis stopped under {stopped}", False))
        else:
            claims.append(ordered(known, said + who))
    return tuple(claims)
