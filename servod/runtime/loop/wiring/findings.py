"""What the bounded test before the first torque can find, and how each finding is told: one table, as for faults.

Beside the data path. The loop runs the test (servod.runtime.loop.wiring.wiring_test) and hands over a row of numbers;
log,
status and command line make their sentences of it here.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple


class WiringOutcome(IntEnum):
    """How a test ended: which check it failed, or that it passed them all. The number is what the loop reports."""

    PASSED = 0
    TORQUE_POLARITY = 1
    ENCODER_DIRECTION = 2
    AMPLIFIER_DIRECTION = 3
    ENCODER_STILL = 4
    AMPLIFIER_STILL = 5
    POSITION_SCALE = 6
    TORQUE_ACTUAL = 7
    RATED_TORQUE = 8
    NO_MOTION = 9
    ONE_WAY = 10
    TOO_EASY = 11
    TOO_HEAVY = 12
    TOO_FAST = 13
    TRAVEL = 14
    SPEED = 15
    NOT_AT_REST = 16
    TIMEOUT = 17
    INTERRUPTED = 18
    TORQUE_AT_REST = 19


class WiringReport(NamedTuple):
    """One test as the loop reports it, in joint coordinates; NaN where nothing was measured."""

    finding: int  # servod.runtime.loop.wiring.findings.WiringOutcome
    found: float  # what the failed check saw, in its own unit
    lowest: float  # and what it allows
    highest: float
    positive_nm: float  # torque at which the joint began to move, with its sign
    negative_nm: float
    amplifier_per_encoder: float  # way of the amplifier's position over the encoder's
    actual_per_demand: float  # 0x6077 over the demanded torque, as the slope of a line through both directions
    travel_rad: float  # furthest from the start
    left_rad: float  # from the start at the end
    speed_rad_s: float  # highest
    noise_rad: float  # of the encoder at rest
    duration_s: float
    expected_nm: float  # friction that was stated or that the model has; NaN where nobody says
    scale_factor: float  # a torque wrong by less than this would have passed too; infinite where nothing bounds it

    @property
    def passed(self) -> bool:
        """Polarity, scale and directions are proven."""
        return self.finding == WiringOutcome.PASSED

    @property
    def friction_nm(self) -> float:
        """Half of what lies between both break-aways: friction alone, a constant load left out."""
        return 0.5 * (self.positive_nm - self.negative_nm)

    @property
    def load_nm(self) -> float:
        """Torque that holds the constant load (gravity, spring, offset)."""
        return 0.5 * (self.positive_nm + self.negative_nm)


class _Row(NamedTuple):
    """One finding: the sentence, with `found`, `lowest`, `highest` to be filled in, and the remedy."""

    text: str
    remedy: str


_F = WiringOutcome
_SCALES = "encoder.counts_per_turn, amplifier.counts_per_turn and amplifier.gear_ratio against the data sheets"
_RATED = (
    "compare 0x6076 with the data sheet, state amplifier.rated_torque_mnm, check amplifier.quirks and "
    "amplifier.gear_ratio"
)
_KNOWN = "wiring_proof.friction_nm and wiring_proof.inertia (or the file that `model` names)"

#: What each finding is called, and what to do. None of the sentences holds for a test that passed.
FINDINGS: dict[WiringOutcome, _Row] = {
    _F.TORQUE_POLARITY: _Row(
        "positive torque moves the joint backwards by both sensors: wrong polarity of the torque",
        "turn round amplifier.torque_direction (or the drive's 0x607E)",
    ),
    _F.ENCODER_DIRECTION: _Row(
        "positive torque moves the encoder backwards, and the amplifier's sensor forwards: wrong polarity of the "
        "encoder",
        "turn the joint by hand, the drive disabled, in the direction that shall be positive: if the position of "
        "`servoctl status` falls, turn round encoder.direction; if it rises, turn round both "
        "amplifier.torque_direction and amplifier.position_direction (or the drive's 0x607E)",
    ),
    _F.AMPLIFIER_DIRECTION: _Row(
        "positive torque moves the amplifier's sensor backwards, and the encoder forwards: wrong polarity of the "
        "amplifier's position",
        "turn the joint by hand, the drive disabled, in the direction that shall be positive: if the position of "
        "`servoctl status` rises, turn round amplifier.position_direction; if it falls, turn round both "
        "encoder.direction and amplifier.torque_direction",
    ),
    _F.ENCODER_STILL: _Row(
        "the amplifier's sensor moved by {found:.3g} rad, the encoder stood still",
        "check the encoder's coupling and cable, and counts_per_turn of both",
    ),
    _F.AMPLIFIER_STILL: _Row(
        "the encoder moved by {found:.3g} rad, the amplifier's sensor stood still",
        "check the motor encoder's coupling and cable, and counts_per_turn of both",
    ),
    _F.POSITION_SCALE: _Row(
        "the {longer} sensor moved {times:.2g} times as far as the {shorter}: wrong scale, {highest:.2g} times are "
        "allowed",
        f"check {_SCALES}",
    ),
    _F.TORQUE_ACTUAL: _Row(
        "the torque that the drive shows (0x6077) is {found:.3g} times the demanded one, {lowest:.3g} to {highest:.3g} "
        "are allowed",
        "check the drive's limits (0x6072, 0x60E0, 0x60E1, current), its current controller, and the mapping of 0x6077",
    ),
    _F.TORQUE_AT_REST: _Row(
        "the drive shows {found:.3g} N*m (0x6077) while none is demanded, {lowest:.3g} to {highest:.3g} are allowed: "
        "it gives a torque of its own, or shows a wrong one",
        "check the drive's torque offset (0x60B2), the zero of its current sensors, and the mapping of 0x6077",
    ),
    _F.RATED_TORQUE: _Row(
        "limits.torque_nm is {found:.3g} times the drive's rated torque at the joint, {lowest:.3g} to {highest:.3g} "
        "are plausible: the scale of the torque is wrong, or the limit",
        f"{_RATED}, and limits.torque_nm",
    ),
    _F.NO_MOTION: _Row(
        "the joint did not move under {found:.3g} N*m in either direction: it is blocked or braked, or the scale of "
        "the torque is wrong",
        f"free the joint; {_RATED}; raise wiring_proof.torque_nm or limits.torque_nm if its friction is that large; "
        "where the way to rest narrows the torque (`servoctl status`), see heartbeat.command_deadline_ms",
    ),
    _F.ONE_WAY: _Row(
        "the joint moved in one direction, and not under {found:.3g} N*m in the other: it stands at a stop, or a "
        "constant load, or its friction that way, is larger than that torque",
        "move it away from the stop by hand with the drive disabled; raise wiring_proof.torque_nm if the load is that "
        "large; where the way to rest narrows the torque (`servoctl status`), see heartbeat.command_deadline_ms",
    ),
    _F.TOO_EASY: _Row(
        "the joint moves at {found:.3g} N*m already, at least {lowest:.3g} N*m were expected: the scale of the torque "
        "is wrong",
        f"{_RATED}; if the scale is right and the joint so free, state {_KNOWN}, friction_nm: 0 where there is none",
    ),
    _F.TOO_HEAVY: _Row(
        "the joint needs {found:.3g} N*m to move, at most {highest:.3g} N*m were expected: the scale of the torque is "
        "wrong, or something drags",
        f"{_RATED}; free the joint; correct {_KNOWN} if they are wrong",
    ),
    _F.TOO_FAST: _Row(
        "the joint took up {found:.3g} times the energy that the torque can have given it, at most {highest:.3g} are "
        "allowed: the scale of the torque is wrong",
        f"{_RATED}; correct {_KNOWN} if they are wrong",
    ),
    _F.TRAVEL: _Row(
        "the joint moved by {found:.3g} rad, {highest:.3g} rad are allowed: it did not stop when the torque ended",
        "look for a load that friction does not hold, a far too large torque (0x6076), or raise "
        "wiring_proof.most_travel_rad",
    ),
    _F.SPEED: _Row(
        "the joint went at {found:.3g} rad/s, {highest:.3g} rad/s are allowed",
        "look for a far too large torque (0x6076) or a wrong scale of the encoder, or raise wiring_proof.speed_rad_s "
        "and limits.speed_rad_s",
    ),
    _F.NOT_AT_REST: _Row(
        "the joint moved by {found:.3g} rad without any torque: it does not hold itself, so there is no small torque "
        "that tells anything",
        "balance the load or let it lie on its stop; hold the joint until it is at rest, then enable again",
    ),
    _F.TIMEOUT: _Row(
        "the test was not over after {highest:.3g} s",
        "look for late or lost feedback (`servoctl status`), or raise wiring_proof.timeout_s",
    ),
    _F.INTERRUPTED: _Row(
        "the test was ended from outside before it had an answer",
        "enable again; a fault beside this one says why",
    ),
}


def wiring_sentence(proof: WiringReport) -> str:
    """What a test found, in one line: what was measured, or which check failed, found, allowed and remedy."""
    if proof.passed:
        return f"wiring in order: {_measured(proof)}; {_scale(proof)}"
    outcome = WiringOutcome(int(proof.finding))
    row = FINDINGS[outcome]
    text = row.text.format(found=proof.found, lowest=proof.lowest, highest=proof.highest, **_longer(proof.found))
    return f"wiring test failed ({outcome.name}): {text}; {row.remedy}. Measured: {_measured(proof)}"


def wiring_document(proof: WiringReport) -> dict[str, Any]:
    """A test for JSON: its finding, the sentence, and every figure; None where nothing was measured."""
    figures = {name: _finite(value) for name, value in zip(WiringReport._fields[1:], proof[1:], strict=True)}
    return {
        "finding": WiringOutcome(int(proof.finding)).name,
        "passed": proof.passed,
        "text": wiring_sentence(proof),
        "friction_nm": _finite(proof.friction_nm),
        "load_nm": _finite(proof.load_nm),
        **figures,
    }


def _longer(ratio: float) -> dict[str, Any]:
    """Which sensor moved further, in words, and how many times; `ratio` is the amplifier's way over the encoder's."""
    first, second = ("amplifier's", "encoder's") if ratio > 1.0 else ("encoder's", "amplifier's")
    return {"longer": first, "shorter": second, "times": max(ratio, 1.0 / ratio) if ratio > 0.0 else math.inf}


def _scale(proof: WiringReport) -> str:
    """How sharply a test that passed has proven the scale of the torque, and what would make it sharper."""
    known = math.isfinite(proof.scale_factor)
    only = "only " if known else ""
    how = f"to within a factor of {proof.scale_factor:.2g}" if known else "not at all, for nothing bounds it"
    if math.isfinite(proof.expected_nm) and known:
        return f"the scale of the torque is known {how}"
    return f"the scale of the torque is known {only}{how}: state {_KNOWN}"


def _measured(proof: WiringReport) -> str:
    """The figures that there are."""
    parts = [
        ("moves at {:+.3g} N*m", proof.positive_nm),
        ("moves at {:+.3g} N*m", proof.negative_nm),
        ("friction {:.3g} N*m", proof.friction_nm),
        ("constant load {:+.3g} N*m", proof.load_nm),
        ("amplifier's way over encoder's {:.3f}", proof.amplifier_per_encoder),
        ("0x6077 over demand {:.3f}", proof.actual_per_demand),
        ("travel {:.3g} rad", proof.travel_rad),
        ("left over {:.2g} rad", proof.left_rad),
        ("speed {:.2g} rad/s", proof.speed_rad_s),
        ("{:.2f} s", proof.duration_s),
    ]
    return ", ".join(text.format(value) for text, value in parts if math.isfinite(value))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
