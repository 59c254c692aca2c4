"""Every kind of fault that a soak puts to the axis: what is injected, what it explains, and how a person recovers.

The actions are those of the fault campaign. A fault that is latched and not in the `explains` of the kind that was
injected has no cause in the schedule, and counts as unexplained.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, replace
from typing import Any

from servod.common.faults import FAULTS, FaultCode
from servod.qualify.faults.scenario import FEEDBACK_LOSS_MS, MASTER_LOSS_MS, Injection, Recovery

_F = FaultCode
#: What any motion may cause, with or without a fault: the limits at work.
ALWAYS = frozenset({_F.TORQUE_CLIPPED, _F.TORQUE_RATE_CLIPPED, _F.DRIVE_LIMITS_TORQUE})
#: A joint that was moving when its torque went: what its motion then may exceed.
_MOTION = frozenset({_F.FOLLOWING_ERROR, _F.SPEED_LIMIT, _F.ENCODER_IMPLAUSIBLE})
#: What the axis sees of a node that is not there, besides its silence.
_NODE_GONE = _MOTION | {
    *(_F.FEEDBACK_STALE, _F.NODE_HEARTBEAT_LOST, _F.DRIVE_FAULT, _F.DRIVE_LEFT_OPERATION, _F.DRIVE_STAYS_POWERED),
    *(_F.DRIVE_RESET, _F.DRIVE_MODE_WRONG, _F.ENCODER_ALARM, _F.COMMANDS_LOST, _F.NODE_LEFT_OPERATIONAL),
    _F.SECOND_MASTER,
}


@dataclass(frozen=True)
class Between:
    """A whole number drawn from a range, both ends included."""

    low: int
    high: int


@dataclass(frozen=True)
class OneOf:
    """One of some values."""

    values: tuple[Any, ...]


@dataclass(frozen=True)
class InjectionKind:
    """One kind. `do` and `undo` are actions of servod.qualify.faults.actions, with ranges where a number is drawn.

    `expects`: one of these at least is latched, within `latched_ms` of the injection; empty: the axis rides through it,
    and its trace on the bus (servod.qualify.soak.traces) shows that it happened. Where something is expected, the drive
    has left the controller's command within `left_ms`, and the joint feels no torque from `gone_ms` on. `takes_syncs`:
    SYNC frames of this axis may be missing on the bus; `deaf_cycles`: so many commands may not reach the drive;
    `of_control`: the controller must act for it to be seen.
    """

    name: str
    do: dict[str, dict[str, Any]]
    expects: frozenset[FaultCode] = frozenset()
    explains: frozenset[FaultCode] = frozenset()
    undo: dict[str, dict[str, Any]] | None = None
    latched_ms: float = 0.0
    left_ms: float = 0.0
    gone_ms: float = 0.0
    watch_ms: int = 300
    recovery: Recovery = Recovery.NONE
    takes_syncs: bool = False
    deaf_cycles: int = 0
    of_control: bool = False

    def injection(self, chance: random.Random) -> Injection:
        """One occurrence, its numbers drawn."""
        return Injection(at_ms=0.0, do=_drawn(self.do, chance))

    def repair(self) -> Injection | None:
        """What takes the cause away; None when it goes by itself."""
        return None if self.undo is None else Injection(at_ms=0.0, do=self.undo)

    def while_proving(self) -> InjectionKind:
        """The same when the wiring is being tested: whatever spoils the test may end it."""
        spoilt = frozenset({_F.WIRING_NOT_PROVEN})
        expects = self.expects | spoilt if self.expects else self.expects
        return replace(self, expects=expects, explains=self.explains | spoilt)

    @property
    def explained(self) -> int:
        """Bits of all faults that may be seen after it."""
        return fault_bits(self.expects | self.explains | ALWAYS)


def fault_bits(codes: frozenset[FaultCode]) -> int:
    """The fault word of `codes`."""
    return sum(FAULTS[code].bit for code in codes)


def _drawn(template: Any, chance: random.Random) -> Any:
    if isinstance(template, dict):
        return {key: _drawn(value, chance) for key, value in template.items()}
    if isinstance(template, Between):
        return chance.randint(template.low, template.high)
    return chance.choice(template.values) if isinstance(template, OneOf) else template


Action = dict[str, dict[str, Any]]


def _frames(of: str | OneOf, fault: str, low: int, high: int, detail: int | Between = 0) -> Action:
    return {"frames": {"of": of, "fault": fault, "count": Between(low, high), "detail": detail}}


def _write(who: str, index: int, subindex: int, value: Any) -> Action:
    return {"object_write": {"who": who, "index": index, "subindex": subindex, "value": value}}


def _silence(who: str | OneOf, low_ms: int, high_ms: int) -> Action:
    return {"silence": {"who": who, "for_ms": Between(low_ms, high_ms)}}


def _nmt(who: str, *commands: str) -> Action:
    return {"nmt": {"who": who, "command": OneOf(commands) if len(commands) > 1 else commands[0]}}


def _node(
    name: str, do: Action, undo: Action | None = None, takes_syncs: bool = False, left_ms: float = MASTER_LOSS_MS
) -> InjectionKind:
    """A participant that is reset, stopped or away for long: it must be configured again."""
    expects = frozenset(
        {
            *(_F.FEEDBACK_STALE, _F.DRIVE_RESET, _F.DRIVE_LEFT_OPERATION, _F.NODE_HEARTBEAT_LOST, _F.DRIVE_FAULT),
            *(_F.BUS_OFF, _F.BUS_DOWN, _F.NODE_LEFT_OPERATIONAL),
        }
    )
    return InjectionKind(
        name,
        do,
        expects,
        _NODE_GONE,
        undo,
        latched_ms=left_ms,
        left_ms=left_ms,
        gone_ms=MASTER_LOSS_MS,
        watch_ms=1200,
        recovery=Recovery.RESTART,
        takes_syncs=takes_syncs,
    )


def _encoder(name: str, do: Action, undo: Action | None = None) -> InjectionKind:
    """The encoder does not answer any more, which is a loss of feedback."""
    return _node(name, do, undo, left_ms=FEEDBACK_LOSS_MS)


def _commanded(kind: InjectionKind) -> InjectionKind:
    """A node whose NMT state somebody else changed: his command is seen before the node is missed."""
    return replace(kind, expects=kind.expects | {_F.SECOND_MASTER})


def _commands(name: str, do: Action) -> InjectionKind:
    """No command reaches the drive for longer than it waits for one."""
    expects = frozenset({_F.COMMANDS_LOST, _F.DRIVE_FAULT, _F.DRIVE_LEFT_OPERATION})
    return replace(_node(name, do), expects=expects, deaf_cycles=60)


def _resettable(
    name: str, do: Action, expects: set[FaultCode], undo: Action | None = None, latched_ms: float = FEEDBACK_LOSS_MS
) -> InjectionKind:
    """A fault after which the axis can be enabled again once its cause is gone; the drive's ramps need their time."""
    return InjectionKind(
        name,
        do,
        frozenset(expects),
        _MOTION | {_F.DRIVE_LEFT_OPERATION},
        undo,
        latched_ms=latched_ms,
        left_ms=latched_ms,
        gone_ms=latched_ms + MASTER_LOSS_MS,
        watch_ms=round(latched_ms) + 450,
        recovery=Recovery.RESET_FAULT,
    )


def _drive(name: str, subindex: int, value: Any, normal: int) -> InjectionKind:
    """A cause of a fault inside the drive, and its end."""
    do, undo = (_write("amplifier", 0x2000, subindex, v) for v in (value, normal))
    return _resettable(name, do, {_F.DRIVE_FAULT, _F.DRIVE_LEFT_OPERATION}, undo)


_CYCLIC = OneOf(("torque", "drive_feedback", "encoder_feedback"))
#: An error code of each class of CiA 301 that a drive has for itself.
_DRIVE_ERRORS = (0x2310, 0x3210, 0x4310, 0x5441, 0x6320, 0x7300, 0x8611, 0xFF01)
#: A download of a warning into the encoder, as the bytes of its frame.
_WARNING = "2B00200201000000"
_NAN_GAINS: Action = {"gains": {"law": "pd", "parameters": ["nan", "nan", 0.0]}}
_GOOD_GAINS: Action = {"gains": {"law": "pd", "parameters": [2.5, 0.12, 0.0]}}

KINDS: tuple[InjectionKind, ...] = (
    # Ridden through.
    InjectionKind("drive feedback lost, a few", _frames("drive_feedback", "drop", 1, 15)),
    InjectionKind("encoder feedback lost, a few", _frames("encoder_feedback", "drop", 1, 15)),
    InjectionKind("torque frames lost, a few", _frames("torque", "drop", 1, 15)),
    InjectionKind("torque frames late", _frames("torque", "late", 1, 10, 20)),
    InjectionKind("drive feedback late", _frames("drive_feedback", "late", 1, 5, 12)),
    InjectionKind("encoder feedback late", _frames("encoder_feedback", "late", 1, 5, 12)),
    InjectionKind("cyclic frames twice", _frames(_CYCLIC, "duplicate", 1, 50)),
    InjectionKind("cyclic frames reordered", _frames(_CYCLIC, "reorder", 1, 50)),
    InjectionKind("drive feedback cut short", _frames("drive_feedback", "shorten", 1, 15, Between(1, 7))),
    InjectionKind("encoder feedback cut short", _frames("encoder_feedback", "shorten", 1, 15, Between(1, 3))),
    # A drive that is away may miss a heartbeat of the master, which it rides through or not (below).
    InjectionKind("encoder away for a moment", _silence("encoder", 5, 12)),
    InjectionKind(
        "a stranger talks", {"babble": {"can_id": OneOf((0x184, 0x183, 0x7FF)), "for_ms": 250, "each_ms": 2}}
    ),
    InjectionKind("SYNC lost, a few", _frames("sync", "drop", 1, 10), takes_syncs=True),
    InjectionKind("frames destroyed", _frames("any", "destroy", 1, 5)),
    InjectionKind("torque frame destroyed", _frames("torque", "destroy", 1, 5)),
    # Stopped, and enabled again after a reset.
    # Feedback is missed after 20 cycles in virtual time, and after 50 on the wall clock.
    replace(  # a drive that cannot be seen to stop is told by NMT, which its PDOs do not survive
        _resettable("drive feedback lost, many", _frames("drive_feedback", "drop", 55, 60), {_F.FEEDBACK_STALE}),
        undo={"frames_pass": {}},
        explains=_NODE_GONE,
        recovery=Recovery.RESTART,
    ),
    _resettable("encoder feedback lost, many", _frames("encoder_feedback", "drop", 55, 200), {_F.FEEDBACK_STALE}),
    replace(
        _resettable("torque frames cut short", _frames("torque", "shorten", 1, 5, Between(1, 3)), {_F.DRIVE_FAULT}),
        latched_ms=70.0,  # told by EMCY, and the monitor of the nodes looks every 20 ms
        left_ms=70.0,
        deaf_cycles=50,  # the drive still stops by its ramp
    ),
    _resettable(
        "position bit of the encoder wrong",
        _frames("encoder_feedback", "flip", 1, 50, Between(18, 27)),
        {_F.ENCODER_IMPLAUSIBLE, _F.SPEED_LIMIT, _F.POSITION_LIMIT},
    ),
    _resettable(
        "state of the drive wrong",
        _frames("drive_feedback", "flip", 1, 1, Between(0, 2)),
        {_F.DRIVE_STATUS_UNKNOWN, _F.DRIVE_LEFT_OPERATION},
    ),
    _drive("error in the drive", 1, OneOf(_DRIVE_ERRORS), 0),
    _drive("safe torque off", 2, 1, 0),
    _drive("supply too low", 3, Between(0, 17_000), 48_000),
    _drive("supply too high", 3, Between(61_000, 90_000), 48_000),
    _resettable(
        "encoder alarm",
        _write("encoder", 0x2000, 1, Between(1, 3)),
        {_F.ENCODER_ALARM},
        _write("encoder", 0x2000, 1, 0),
    ),
    replace(_resettable("gains without numbers", _NAN_GAINS, {_F.NOT_FINITE}, _GOOD_GAINS), of_control=True),
    _resettable(
        "another mode asked for",
        _write("amplifier", 0x6060, 0, OneOf((1, 3, 8, 9))),
        {_F.DRIVE_MODE_WRONG, _F.FOLLOWING_ERROR},
        _write("amplifier", 0x6060, 0, 10),
        latched_ms=400.0,
    ),
    # The nodes must be configured again.
    replace(
        _encoder("a service tool writes", {"foreign_frame": {"can_id": 0x602, "data": _WARNING}}),
        expects=frozenset({_F.FOREIGN_SDO}),
    ),
    # The drive hears no command within its deadline, not even the one that stops it: it is stopped by NMT.
    _commands("torque frames lost, many", _frames("torque", "drop", 40, 60)),
    _commands("torque frames cut short, many", _frames("torque", "shorten", 40, 60, Between(1, 3))),
    # One that is lost may be ridden through or not: the drive waits for two periods, and the next comes as they end.
    _node("master's heartbeat lost", _frames("master_heartbeat", "drop", 4, 8)),
    _encoder("encoder cut off", _silence("encoder", 40, 600)),
    _node("drive cut off", _silence("amplifier", 40, 600)),
    _node("loop cut off", _silence("loop", 200, 600), takes_syncs=True),
    _commanded(_encoder("encoder reset", _nmt("encoder", "reset_node", "reset_communication"))),
    _commanded(_node("drive reset", _nmt("amplifier", "reset_node", "reset_communication"))),
    _commanded(_encoder("encoder pre-operational", _nmt("encoder", "pre_operational"))),
    _commanded(_node("drive pre-operational", _nmt("amplifier", "pre_operational"))),
    # A stopped node answers no SDO, so that nobody can ask who it is: a person sends this, or takes its supply away.
    _commanded(_encoder("encoder stopped", _nmt("encoder", "stop"), _nmt("encoder", "pre_operational"))),
    _commanded(_node("drive stopped", _nmt("amplifier", "stop"), _nmt("amplifier", "pre_operational"))),
    _encoder("encoder bus-off", {"bus_off": {"who": "encoder"}}),
    _node("drive bus-off", {"bus_off": {"who": "amplifier"}}),
    _node("loop's interface down", {"interface_down": {"for_ms": Between(1, 500)}}, takes_syncs=True),
    _node("loop bus-off", {"bus_off": {"who": "loop"}}, takes_syncs=True),
)
