"""The judge: what the drive's own record says about a scenario, held against what the scenario expects."""

from __future__ import annotations

from dataclasses import dataclass

from servod.common.errors import BadInput
from servod.drivers.virtual.drive_record import DriveSample
from servod.qualify.faults.actions import action_of
from servod.qualify.faults.evidence import Watch, motion_complaints, record_complaints
from servod.qualify.faults.scenario import FEEDBACK_LOSS_MS, MASTER_LOSS_MS, Expectation, Loss, Scenario
from servod.qualify.faults.stops import NO_TORQUE_NM, stop_complaints, stop_of
from servod.qualify.faults.under_test import Observation
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.wiring.findings import WiringOutcome

_NS_PER_MS = 1e6


@dataclass(frozen=True)
class ReactionTimes:
    """Times of the reaction after the first injection, in ms of bus time; None: it did not happen.

    `left_ms`: the drive left operation enabled, by command or by itself; `gone_ms`: the joint feels no torque any more,
    to the end of the record.
    """

    left_ms: float | None
    gone_ms: float | None


def reaction(samples: list[DriveSample], injected_ns: int) -> ReactionTimes:
    """What the drive did after `injected_ns`."""
    after = [s for s in samples if s.time_ns >= injected_ns]
    if not after:
        return ReactionTimes(None, None)
    left = next((s.time_ns for s in after if s.state is not DriveState.OPERATION_ENABLED), None)
    stop = stop_of(samples, injected_ns)
    return ReactionTimes(_ms(left, injected_ns), None if stop is None else stop.gone_ms)


def complaints(scenario: Scenario, seen: Observation, times: ReactionTimes, watch: Watch) -> list[str]:
    """Everything in which the outcome differs from what was expected, or cannot be told; empty when it passed."""
    after = [sample for sample in seen.samples if sample.time_ns > watch.injected_ns]
    states = {sample.state.name for sample in after}
    found = [
        *record_complaints(scenario, seen.samples, watch),
        *_complaints(scenario.expect, seen, times),
        *_on_the_way(scenario.expect, states),
        _limited(scenario.expect.most_nm, after),
        _sunk(scenario.expect.sinks_rad, seen.samples, watch),
        *motion_complaints(scenario, seen.samples, watch),
        *stop_complaints(scenario, loss_of(scenario), seen.samples, watch.injected_ns, seen.stated),
    ]
    return [text for text in found if text]


def _complaints(expected: Expectation, seen: Observation, times: ReactionTimes) -> list[str]:
    names = {code.name for code in seen.latched}
    return [
        "" if seen.axis in expected.axis else f"the axis ended {seen.axis}, expected {' or '.join(expected.axis)}",
        _named(set(expected.faults), names),
        *(f"{name} is shown as well" for name in expected.never_told if name in names),
        _in_time("the drive left the controller's command", times.left_ms, expected.reaction_ms),
        _in_time("the torque was gone", times.gone_ms, expected.torque_gone_ms),
        _refused(expected.refused, seen.refusal),
        _says(expected.says, seen.says),
        _error_shown(expected.drive_error, seen.drive_errors),
        "" if (seen.lost_records or 0) <= expected.lost_records else f"{seen.lost_records} cycle records are missing",
        _commanded(seen),
    ]


def _on_the_way(expected: Expectation, states: set[str]) -> list[str]:
    """The path by which the drive got there."""
    missing, unwanted = set(expected.drive_shows) - states, set(expected.drive_never) & states
    return [
        f"the drive never showed {', '.join(sorted(missing))}" if missing else "",
        f"the drive showed {', '.join(sorted(unwanted))}" if unwanted else "",
    ]


def _limited(most_nm: float | None, after: list[DriveSample]) -> str:
    """The limit that was to hold."""
    felt_nm = max((abs(sample.torque_nm) for sample in after), default=0.0)
    return (
        f"the joint felt {felt_nm:.3f} N*m, expected {most_nm:g}" if most_nm is not None and felt_nm > most_nm else ""
    )


def _sunk(sinks_rad: float | None, samples: list[DriveSample], watch: Watch) -> str:
    """How far a load fell until the brake held it, by the drive's record of the true joint."""
    before = [sample.position_rad for sample in samples if sample.time_ns <= watch.injected_ns]
    if sinks_rad is None or not before:
        return ""
    sunk_rad = max(abs(s.position_rad - before[-1]) for s in samples if s.time_ns >= watch.injected_ns)
    return "" if sunk_rad <= sinks_rad else f"the joint went {sunk_rad:.4f} rad away, expected {sinks_rad:g}"


def _named(expected: set[str], names: set[str]) -> str:
    if not expected or names & expected:
        return ""
    return f"the faults shown are {', '.join(sorted(names)) or 'none'}, expected {' or '.join(sorted(expected))}"


def _in_time(what: str, happened_ms: float | None, limit_ms: float | None) -> str:
    if limit_ms is None or (happened_ms is not None and happened_ms <= limit_ms):
        return ""
    return f"{what} {'never' if happened_ms is None else f'after {happened_ms:.0f} ms'}, expected {limit_ms:g} ms"


def _refused(words: str | None, refusal: str) -> str:
    if words is None:
        return f"refused: {refusal}" if refusal else ""
    return "" if words in refusal else f"the refusal says {refusal or 'nothing'!r}, expected {words!r}"


def _says(name: str | None, outcome: WiringOutcome | None) -> str:
    """The wiring test names what is wrong: each finding has a remedy of its own."""
    if name is None or (outcome is not None and outcome.name == name):
        return ""
    return f"the wiring test says {outcome.name if outcome else 'nothing'}, expected {name}"


def _error_shown(code: int | None, shown: frozenset[int]) -> str:
    """The drive's own word for its fault, by which a person looks it up in the manual."""
    if code is None or shown == {code}:
        return ""
    names = ", ".join(f"0x{number:04X}" for number in sorted(shown))
    return f"the drive's error codes shown are {names or 'none'}, expected 0x{code:04X}"


def _commanded(seen: Observation) -> str:
    """No scenario ends with torque that nobody commands."""
    if not seen.samples or seen.axis == AxisState.ENABLED.name:
        return ""
    torque_nm = seen.samples[-1].torque_nm
    return f"the joint feels {torque_nm:.4f} N*m that nobody commands" if abs(torque_nm) > NO_TORQUE_NM else ""


def _ms(time_ns: int | None, since_ns: int) -> float | None:
    return None if time_ns is None else (time_ns - since_ns) / _NS_PER_MS


# --- What is lost ----------------------------------------------------------------------------------------------------
# What a scenario takes from the axis, by its actions and not by its own word, and whether it is bound as it must be. A
# scenario to which the bound does not apply says why (`exempt`), and is counted and shown.


def loss_of(scenario: Scenario) -> Loss:
    """The loss with the tightest bound among those of its actions; an axis without power has nothing to lose."""
    if not scenario.start.powered:
        return Loss.NONE
    losses = {action_of(i, scenario.title, scenario.runs).loss() for i in scenario.inject}
    return next((loss for loss in (Loss.FEEDBACK, Loss.MASTER) if loss in losses), Loss.NONE)


def check_bounds(scenario: Scenario, where: str) -> None:
    """Raises BadInput for a loss without its bound, and for an exemption from none."""
    expected, loss = scenario.expect, loss_of(scenario)
    if expected.exempt is not None:
        if loss is Loss.NONE:
            raise BadInput(f"{where}: expect.exempt", "a scenario that takes nothing away", "no exemption")
    elif loss is Loss.MASTER and not _within(expected.torque_gone_ms, MASTER_LOSS_MS):
        raise _unbound(expected, where, "torque_gone_ms", MASTER_LOSS_MS, "the master")
    elif loss is Loss.FEEDBACK and not _within(expected.reaction_ms, FEEDBACK_LOSS_MS):
        raise _unbound(expected, where, "reaction_ms", FEEDBACK_LOSS_MS, "feedback")


def _within(stated_ms: float | None, bound_ms: float) -> bool:
    return stated_ms is not None and stated_ms <= bound_ms


def _unbound(expected: Expectation, where: str, key: str, bound_ms: float, what: str) -> BadInput:
    allowed = f"{key} of at most {bound_ms:g} after a loss of {what}, or `exempt` with the reason"
    return BadInput(f"{where}: expect.{key}", getattr(expected, key), allowed)
