"""What a stop took, by the drive's own record of the true joint, against what servod stated before.

Part of the judge. Nothing here is reckoned: speeds and ways are read off, and compared with the stated figures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from servod.drivers.virtual.drive_record import DriveSample
from servod.formats.stopping import StoppingStatus
from servod.qualify.faults.scenario import Loss, Scenario
from servod.runtime.fieldbus.devices import DriveState

#: Less than one count of the drive's torque is none.
NO_TORQUE_NM = 1e-9
#: The record has a sample at each event of the drive, and else one in 2 ms.
_RECORD_MS = 2.5
#: A joint that is no faster when its torque goes was braked; a faster one coasts, which only a scenario that says why
#: may (`coasts`): else a lost ramp would pass.
_BRAKED_RAD_S = 0.1
_NS_PER_MS = 1e6


class StopSeen(NamedTuple):
    """One stop: times in ms from `since_ns`, None for what did not come; the fastest until the torque was gone, and the
    speed then."""

    since_ns: int
    gone_ms: float | None
    fastest_rad_s: float
    to_gone_rad: float
    to_rest_rad: float
    gone_rad_s: float


def stop_of(samples: Sequence[DriveSample], since_ns: int) -> StopSeen | None:
    """What the drive and its joint did from `since_ns` on; None where the record has nothing of it."""
    begin = next((number for number, s in enumerate(samples) if s.time_ns >= since_ns), len(samples))
    after = samples[begin:]
    if not after:
        return None
    here_rad = samples[max(begin - 1, 0)].position_rad
    last = max((number for number, s in enumerate(after) if not abs(s.torque_nm) <= NO_TORQUE_NM), default=-1)
    gone = after[last + 1] if last + 1 < len(after) else None
    felt = after[: last + 2]
    return StopSeen(
        since_ns,
        None if gone is None else (gone.time_ns - since_ns) / _NS_PER_MS,
        max(abs(s.velocity_rad_s) for s in felt),
        max(abs(s.position_rad - here_rad) for s in felt),
        max(abs(s.position_rad - here_rad) for s in after),
        abs(felt[-1].velocity_rad_s),
    )


def stop_complaints(
    scenario: Scenario, loss: Loss, samples: Sequence[DriveSample], injected_ns: int, stated: StoppingStatus | None
) -> Iterator[str]:
    """Where a stop took more than was stated. What goes on after the injection as if nothing were, until somebody
    notices, is no part of it: then it begins where the drive leaves the controller's command."""
    if not stopped_by(scenario) or stated is None:
        return
    after = [s for s in samples if s.time_ns >= injected_ns]
    left_ns = next((s.time_ns for s in after if s.state is not DriveState.OPERATION_ENABLED), None)
    at_once = loss is not Loss.NONE and scenario.expect.exempt is None
    since_ns = injected_ns if at_once or left_ns is None else left_ns
    seen = stop_of(samples, since_ns)
    if seen is None or seen.gone_ms is None:
        yield "the torque was never gone: no stop that was stated"
        return
    if seen.gone_ms > 1e3 * stated["time_s"] + _RECORD_MS:
        yield f"the torque was gone after {seen.gone_ms:.0f} ms, stated were {1e3 * stated['time_s']:.0f} ms"
    if seen.fastest_rad_s > stated["speed_rad_s"]:
        yield f"the joint turned at {seen.fastest_rad_s:.2f} rad/s, stated were {stated['speed_rad_s']:.2f} rad/s"
    coasts_rad, most_rad, travel_rad = stated["coasts_rad"], stated["travel_rad"], seen.to_rest_rad
    if scenario.expect.coasts is not None or not stated["deceleration_rad_s2"]:
        most_rad = stated["unbraked_rad"] if coasts_rad is None else coasts_rad
    elif seen.gone_rad_s > _BRAKED_RAD_S:
        yield f"the torque was gone at {seen.gone_rad_s:.2f} rad/s: no ramp brought the joint to rest"
    if coasts_rad is None:  # a load takes the joint away when the torque is gone
        travel_rad = seen.to_gone_rad
    if travel_rad > most_rad:
        yield f"the joint went {travel_rad:.3f} rad until it rested, stated were {most_rad:.3f} rad"


def stopped_by(scenario: Scenario) -> bool:
    """The scenario ends in a stop that servod's statement is about."""
    expected = scenario.expect
    return scenario.start.powered and not expected.stays_enabled and expected.unstated is None
