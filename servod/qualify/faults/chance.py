"""Scenarios by chance: an axis at peak torque or top speed, light, heavy or hanging, and one thing that fails.

What servod stated of the stop is what the judge holds each against. The same seed gives the same scenarios.
"""

from __future__ import annotations

import math
import random
from typing import Any, NamedTuple

from servod.common.yaml import validate
from servod.formats.config import AxisConfig
from servod.kernels.stopping import StopFacts, Way, both_ways
from servod.qualify.faults.judge import check_bounds, loss_of
from servod.qualify.faults.scenario import (
    FEEDBACK_LOSS_MS,
    Loss,
    Nested,
    Scenario,
    check_inputs,
    demo_effects,
    merged,
    shipped_config,
)
from servod.runtime.fieldbus.master.planned import narrowed_by_stop

#: Beyond these nothing is stated: the heartbeat alone, and the deadline of the commands [ms].
HEARTBEAT_GONE_MS, DEADLINE_GONE_MS = 300.0, 60.0


class _JointKind(NamedTuple):
    """A joint, the worst of it as its engineer states it, and its top speed."""

    inertia: float
    coulomb: float
    viscous: float
    load_nm: float
    speed_rad_s: float
    within_s: float | None = None  # left out: what servod asks for by itself


_JOINTS = {
    "light": _JointKind(1e-3, 0.006, 2e-4, 0.0, 3.0),
    "lightest": _JointKind(1e-4, 0.002, 1e-5, 0.0, 3.0),
    "heavy": _JointKind(2e-2, 0.02, 1e-3, 0.0, 3.0),
    "heavy, given time": _JointKind(2e-2, 0.02, 1e-3, 0.0, 3.0, 0.5),
    "hanging": _JointKind(4e-3, 0.012, 5e-4, -0.06, 4.0),
    "hanging, held": _JointKind(4e-3, 0.03, 5e-4, -0.02, 4.0),
}
_LIMITS = {
    "torque_nm": 0.3,
    "torque_rate_nm_per_s": 3000.0,
    "position_min_rad": -0.6,
    "position_max_rad": 0.6,
    "following_error_rad": 0.5,
    "stale_cycles": 5,
    "late_cycles": 20,
    "encoder_mismatch_rad": 0.02,
}
#: What the drive does at the deadline of its commands, and what guards then.
_STOPS, _TELLS, _NONE = "stops", "tells", "none"
_DEADLINES = {_STOPS: "deadline and heartbeat", _TELLS: "heartbeat, deadline told", _NONE: "heartbeat alone"}
_DROP = {"fault": "drop"}
_FROZEN, _UNHEARD, _MUTE = "encoder frozen", "commands lost", "SYNC lost"
#: What fails; what of it takes a time until somebody notices is measured from where the drive reacts.
_FAILS: dict[str, Nested] = {
    "both die": {"dies": {"who": ["loop", "supervisor"]}},
    "loop dies": {"dies": {"who": ["loop"]}},
    "supervisor dies": {"dies": {"who": ["supervisor"]}},
    "loop stands still": {"wakes_late": {"most_us": 400_000, "exactly": True, "times": 1}},
    "drive cut off": {"silence": {"who": "amplifier", "for_ms": 60_000}},
    "encoder cut off": {"silence": {"who": "encoder", "for_ms": 60_000}},
    "computer cut off": {"silence": {"who": "loop", "for_ms": 60_000}},
    "bus off": {"bus_off": {"who": "loop"}},
    "interface down": {"interface_down": {"for_ms": 60_000}},
    "queue full": {"queue_stands": {"who": "loop", "for_ms": 60_000}},
    "bus flooded": {"babble": {"can_id": 1, "for_ms": 10_000}},
    _UNHEARD: {"frames": {"of": "torque", **_DROP}},
    _MUTE: {"frames": {"of": "sync", **_DROP}},
    "drive's feedback lost": {"frames": {"of": "drive_feedback", **_DROP}},
    "encoder's feedback lost": {"frames": {"of": "encoder_feedback", **_DROP}},
    "drive stopped by NMT": {"nmt": {"who": "amplifier", "command": "stop"}},
    "drive pre-operational": {"nmt": {"who": "amplifier", "command": "pre_operational"}},
    "drive reset": {"nmt": {"who": "amplifier", "command": "reset_node"}},
    "encoder reset": {"nmt": {"who": "encoder", "command": "reset_node"}},
    "drive too hot": {"object_write": {"who": "amplifier", "index": 0x2000, "subindex": 1, "value": 0x4310}},
    "short circuit": {"object_write": {"who": "amplifier", "index": 0x2000, "subindex": 1, "value": 0x2320}},
    "supply lost": {"object_write": {"who": "amplifier", "index": 0x2000, "subindex": 3, "value": 12_000}},
    "safe torque off": {"object_write": {"who": "amplifier", "index": 0x2000, "subindex": 2, "value": 1}},
    "local control": {"object_write": {"who": "amplifier", "index": 0x2000, "subindex": 4, "value": 1}},
    _FROZEN: {"object_write": {"who": "encoder", "index": 0x2000, "subindex": 3, "value": 1}},
    "encoder alarm": {"object_write": {"who": "encoder", "index": 0x2000, "subindex": 1, "value": 1}},
    "gains not numbers": {"gains": {"law": "pd", "parameters": ["nan", 0.0, 0.0]}},
    "quick stop asked for": {"tell": {"op": "quick_stop"}},
}
#: After these the drive cannot brake, or what stops the axis switches it off.
_COASTS = {
    **dict.fromkeys(
        ("safe torque off", "short circuit", "supply lost"), "the drive's power stage cannot brake any more"
    ),
    "encoder reset": "the fault's reaction is to disable: its position is gone",
    "drive reset": "a drive that begins again has no torque",
    **dict.fromkeys(
        (_FROZEN, "encoder alarm", "gains not numbers"), "the fault's reaction is to disable: no sensor, no number"
    ),
}
#: Nothing watches the commands: what the joint then does is seen, which is not what was stated (docs/safety.md). It is
#: stopped all the same, which is held against a bound of its own.
_UNWATCHED = {
    "unstated": "commands alone lost by a drive without a deadline: a bent torque, a speed or a position shows it",
    "exempt": "commands alone lost by a drive without a deadline: a bent torque, a speed or a position shows it",
    "torque_gone_ms": 1000.0,
}
#: Of the sine's amplitude: where nothing watches the commands, a joint that comes to rest under the torque that its
#: drive holds is seen by its reference alone, and only beyond the following-error window (docs/safety.md).
_WINDOW_SHARE = 0.9
#: Of the time in which an axis that runs away is stopped by its own limits, the part in which something may fail.
_OF_THE_WAY = 0.8
#: Of the reckoning of that time.
_STEP_S = 0.0005
#: Of the sine that brings the axis to its top speed.
_AMPLITUDE_RAD = 0.12
_AT_PEAK, _AT_TOP, _RUNS_AWAY = "at peak torque", "at top speed", "running away"
_SHARES = {_AT_PEAK: 0.7, _AT_TOP: 1.5, _RUNS_AWAY: 0.5}


def drawn(count: int, seed: int) -> dict[str, Scenario]:
    """`count` scenarios by name."""
    chance = random.Random(seed)  # noqa: S311  (a trial, no secret)
    found = {}
    for number in range(count):
        joint, what = chance.choice(sorted(_JOINTS)), chance.choice(sorted(_FAILS))
        how, deadline = chance.choice((_AT_PEAK, _AT_TOP, _RUNS_AWAY)), chance.choice(sorted(_DEADLINES))
        name = f"random/{number + 1}"
        found[name] = _scenario(chance, joint, what, how, deadline)
        check_inputs(found[name], name)
        check_bounds(found[name], name)
    return found


def _scenario(chance: random.Random, joint: str, what: str, how: str, deadline: str) -> Scenario:
    kind, sign = _JOINTS[joint], chance.choice((1.0, -1.0))
    config = _config(kind, deadline)
    unwatched = what == _UNHEARD and deadline == _NONE
    if unwatched and how == _AT_TOP and kind.within_s is None:  # a joint that is given time follows less closely
        config["limits"]["following_error_rad"] = _WINDOW_SHARE * _AMPLITUDE_RAD
    gone_ms = DEADLINE_GONE_MS if deadline == _STOPS and kind.within_s is None else HEARTBEAT_GONE_MS
    facts = _facts(config)
    inject, longest_ms = _brought_there(chance, kind, sign, how, facts)
    title = f"{what}, {how}, {joint} joint, {'forward' if sign > 0 else 'backward'}, {_DEADLINES[deadline]}"
    data = {
        "title": title[:100],
        "why": "Anything may fail at the worst moment.",
        "group": "random",
        "start": "enabled",
        "settings": {"command_deadline": deadline},
        "config": config,
        "plant": {
            "inertia": kind.inertia,
            "friction": {
                "kind": "lugre",
                "sigma0": 2e4 * kind.coulomb,
                "sigma1": 20.0 * kind.coulomb,
                "viscous": kind.viscous,
                "coulomb": kind.coulomb,
                "static": 1.3 * kind.coulomb,
                "stribeck_velocity": 0.1,
            },
        }
        | dict.fromkeys(demo_effects()),
        "inject": [
            *inject,
            {"at_ms": inject[-1]["at_ms"] + chance.uniform(2.0, longest_ms), "do": _FAILS[what], "timed": True},
        ],
        "watch_ms": 2500.0,
        "expect": {"axis": ["FAULT", "DISABLED"], "torque_gone_ms": gone_ms},
        "recover": "repair",
    }
    scenario = validate(data, Scenario, title)
    more: dict[str, Any] = {"coasts": _COASTS.get(what)}
    if unwatched:
        more |= _UNWATCHED
    if what == _FROZEN:
        more["exempt"] = "a frozen encoder shows when the joint has gone on by the mismatch"
        more["torque_gone_ms"] = 2000.0
    elif loss_of(scenario) is Loss.FEEDBACK:
        more["reaction_ms"] = FEEDBACK_LOSS_MS
    return scenario.model_copy(update={"expect": scenario.expect.model_copy(update=more)})


def _config(kind: _JointKind, deadline: str) -> Nested:
    return {
        "limits": {**_LIMITS, "speed_rad_s": kind.speed_rad_s},
        "heartbeat": {"master_period_ms": 50, "drive_timeout_ms": 150}
        | ({"command_deadline_ms": 0} if deadline == _NONE else {}),
        "amplifier": {"quirks": "virtual" if deadline == _STOPS else "none"},
        "stopping": {
            "least_inertia": 0.95 * kind.inertia,
            "most_inertia": 1.05 * kind.inertia,
            "least_friction_nm": 0.9 * kind.coulomb,
            "load_min_nm": 1.02 * kind.load_nm,
        }
        | ({} if kind.within_s is None else {"within_s": kind.within_s}),
    }


def _brought_there(
    chance: random.Random, kind: _JointKind, sign: float, how: str, facts: StopFacts
) -> tuple[list[Nested], float]:
    """Injections that bring the axis to its worst: stiff gains, the load, and a motion or a law that runs away.

    With the time after the last of them beyond which its own limits stop the axis, in ms.
    """
    longest_ms = _SHARES[how] * 1000.0 * facts.hold_s
    damping = 150.0 * kind.inertia
    gains = [chance.uniform(4.0, 8.0) * damping, damping, kind.inertia]
    found: list[Nested] = [{"do": {"gains": {"law": "pd", "parameters": gains}}}]
    if kind.load_nm:
        found.append({"at_ms": 5.0, "do": {"load": {"torque_nm": kind.load_nm}}})
    begin_ms = 300.0
    if how == _AT_PEAK:
        return [*found, {"at_ms": begin_ms, "do": {"step": {"amplitude_rad": sign * 0.45}}}], longest_ms
    frequency_hz = chance.uniform(0.75, 0.9) * _top_rad_s(facts) / (2.0 * math.pi * _AMPLITUDE_RAD)
    found.append(
        {"at_ms": begin_ms, "do": {"sine": {"amplitude_rad": sign * _AMPLITUDE_RAD, "frequency_hz": frequency_hz}}}
    )
    halves = chance.choice((1, 2, 3))
    fastest_ms = begin_ms + 500.0 * halves / frequency_hz
    if how == _AT_TOP:
        return [*found, {"at_ms": fastest_ms - 30.0, "do": {"gains": {"law": "pd", "parameters": gains}}}], longest_ms
    away = {"law": "pd", "parameters": [0.0, -chance.choice((0.5, 5.0, 50.0)) * gains[1], 0.0]}
    found.append({"at_ms": fastest_ms - 20.0, "do": {"gains": away}})
    forward = (sign > 0.0) == (halves % 2 == 0)
    speed_rad_s = 2.0 * math.pi * frequency_hz * _AMPLITUDE_RAD
    room_rad = facts.position_max_rad - facts.load_nm / gains[0]  # which the load has taken already
    away_s = _run_away_s(both_ways(facts)[0 if forward else 1], speed_rad_s, room_rad)
    return found, min(longest_ms, 1000.0 * _OF_THE_WAY * away_s)


def _run_away_s(way: Way, speed_rad_s: float, room_rad: float) -> float:
    """How long a law that asks for all torque that the limits leave it takes to where they stop the joint, in s.

    The load goes on to push a joint that they allow no torque any more: it is there soon, and without one never.
    """
    facts, steps = way.facts, 0
    while not way.too_near(speed_rad_s, room_rad) and steps * _STEP_S < facts.hold_s:
        torque_nm = min(facts.torque_nm, way.most_torque_nm(speed_rad_s, room_rad))
        speed_rad_s += _STEP_S * (torque_nm + way.push_nm) / facts.least_inertia
        room_rad -= _STEP_S * speed_rad_s
        steps += 1
    return steps * _STEP_S


def _facts(over: Nested) -> StopFacts:
    """What the axis reckons its stop with, as its engineer reads it."""
    config = validate(merged(shipped_config(), over), AxisConfig, "random")
    stopping = narrowed_by_stop(config)[1]
    assert stopping is not None
    return stopping.facts


def _top_rad_s(facts: StopFacts) -> float:
    """The speed that the limits let the axis have where the sine has it, either way."""
    speed_rad_s, ways = facts.speed_rad_s, both_ways(facts)
    while any(way.too_near(speed_rad_s, facts.position_max_rad - _AMPLITUDE_RAD) for way in ways):
        speed_rad_s *= 0.95
    return speed_rad_s
