"""Limits: the last word before the wire. They trust neither the controller nor the configuration of the drive.

One call per cycle, after the controller and before the driver. Finite numbers are checked before anything is clamped,
because min() and max() turn NaN into a limit value. What each fault does to the axis stands in
servod.common.faults.FAULTS.
"""

from __future__ import annotations

import math

from servod.common.faults import FAULTS, FaultCode
from servod.formats.config import LimitsConfig
from servod.runtime.fieldbus.devices import AmplifierFeedback, EncoderFeedback

_BIT = {code: fault.bit for code, fault in FAULTS.items()}
_NOT_FINITE = _BIT[FaultCode.NOT_FINITE]
_STALE = _BIT[FaultCode.FEEDBACK_STALE]
_ALARM = _BIT[FaultCode.ENCODER_ALARM]
_MISMATCH = _BIT[FaultCode.ENCODER_IMPLAUSIBLE]
_SPEED = _BIT[FaultCode.SPEED_LIMIT]
_POSITION = _BIT[FaultCode.POSITION_LIMIT]
_FOLLOWING = _BIT[FaultCode.FOLLOWING_ERROR]
_LATE = _BIT[FaultCode.DEADLINE_LATE]
_BUDGET = _BIT[FaultCode.DEADLINE_BUDGET]
_CLIPPED = _BIT[FaultCode.TORQUE_CLIPPED]
_RATE = _BIT[FaultCode.TORQUE_RATE_CLIPPED]
_NOT_PROVEN = _BIT[FaultCode.WIRING_NOT_PROVEN]


#: The test of the wiring ends itself beyond its travel; where it does not, the limits do beyond this multiple of it.
PROVING_TRAVELS = 2.0
#: Skipped periods that one punctual cycle makes up for: a single good cycle does not forgive a starving machine.
_FORGIVEN_PER_CYCLE = 0.05
#: Above this share of the speed limit a joint counts as moving.
_MOVING_SHARE = 0.01


class Limits:
    """Limits of one axis; holds the last torque, the encoder offset at enable and how late the loop has been."""

    def __init__(self, config: LimitsConfig) -> None:
        """Copies the numbers out of `config`, so that the cycle touches plain floats only."""
        self.torque_nm = config.torque_nm
        self.torque_rate_nm_per_s = config.torque_rate_nm_per_s
        self.speed_rad_s = config.speed_rad_s
        self.position_min_rad, self.position_max_rad = config.position_min_rad, config.position_max_rad
        self.following_error_rad = config.following_error_rad
        self.encoder_mismatch_rad = config.encoder_mismatch_rad
        self.stale_cycles, self.late_cycles = config.stale_cycles, config.late_cycles
        self._last_torque_nm = 0.0
        self._encoder_offset_rad = self._armed_at_rad = 0.0
        self._late_level = 0.0

    def arm(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback) -> None:
        """At enable: both position sensors agree by definition now; torque starts from what is produced now."""
        self._encoder_offset_rad = amplifier.position_rad - encoder.position_rad
        self._armed_at_rad = encoder.position_rad
        self._last_torque_nm = amplifier.torque_nm if math.isfinite(amplifier.torque_nm) else 0.0

    def feedback_faults(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback, skipped: int) -> int:
        """Faults of feedback and deadline, which count whether or not the axis is enabled; as fault bits."""
        faults = self._deadline_faults(skipped)
        if amplifier.age_cycles >= self.stale_cycles or encoder.age_cycles >= self.stale_cycles:
            faults |= _STALE
        if encoder.alarms:
            faults |= _ALARM
        # One non-finite summand makes the sum non-finite (an overflow of finite ones is no sane feedback either).
        total = amplifier.position_rad + amplifier.torque_nm + encoder.position_rad + encoder.velocity_rad_s
        if not math.isfinite(total):
            faults |= _NOT_FINITE
        return faults

    def motion_faults(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback, reference_rad: float | None) -> int:
        """Faults of the motion of a powered axis, as fault bits. Comparisons are written so that NaN is a fault.

        `reference_rad` None: the reference is followed no more (the torque is being ramped down).
        """
        faults = 0
        position = encoder.position_rad
        if not abs(encoder.velocity_rad_s) <= self.speed_rad_s:
            faults |= _SPEED
        if not self.position_min_rad <= position <= self.position_max_rad:
            faults |= _POSITION
        if reference_rad is not None and not abs(reference_rad - position) <= self.following_error_rad:
            faults |= _FOLLOWING
        # Positions of two moments differ in motion: a lost frame is for the staleness to judge.
        same_moment = amplifier.age_cycles == encoder.age_cycles
        difference_rad = abs(amplifier.position_rad - position - self._encoder_offset_rad)
        if same_moment and not difference_rad <= self.encoder_mismatch_rad:
            faults |= _MISMATCH
        return faults

    def proving_faults(self, encoder: EncoderFeedback, most_travel_rad: float) -> int:
        """While the wiring is proven: the joint stays near where the test began, whatever the test thinks of it."""
        near = abs(encoder.position_rad - self._armed_at_rad) <= PROVING_TRAVELS * most_travel_rad
        return 0 if near else _NOT_PROVEN

    def limit_torque(self, wanted_nm: float, dt_s: float) -> tuple[float, int]:
        """The torque that may go out, and fault bits of what was limited. Not finite gives zero."""
        if not (math.isfinite(wanted_nm) and math.isfinite(dt_s)):
            self._last_torque_nm = 0.0
            return 0.0, _NOT_FINITE
        faults, torque_nm = 0, wanted_nm
        step_nm = self.torque_rate_nm_per_s * dt_s
        change_nm = wanted_nm - self._last_torque_nm
        if abs(change_nm) > step_nm:
            torque_nm, faults = self._last_torque_nm + math.copysign(step_nm, change_nm), _RATE
        if abs(torque_nm) > self.torque_nm:  # the torque itself has the last word, wherever the ramp began
            torque_nm, faults = math.copysign(self.torque_nm, torque_nm), faults | _CLIPPED
        self._last_torque_nm = torque_nm
        return torque_nm, faults

    def ramp(self, from_nm: float, share: float, velocity_rad_s: float) -> float:
        """Torque of a ramp-down: `share` of what there was, and nothing of a torque that drives the joint on.

        The torque that a failed motion ends with may be the one that does the harm (a wrong polarity); only braking
        and holding torque is taken away slowly.
        """
        drives = from_nm * velocity_rad_s > 0.0 and abs(velocity_rad_s) > _MOVING_SHARE * self.speed_rad_s
        return 0.0 if drives else from_nm * share

    def release(self) -> None:
        """The axis produces no torque: the next ramp starts from zero."""
        self._last_torque_nm = 0.0

    def _deadline_faults(self, skipped: int) -> int:
        self._late_level = max(0.0, self._late_level + skipped - _FORGIVEN_PER_CYCLE)
        late = _LATE if skipped else 0
        return late | (_BUDGET if self._late_level > self.late_cycles else 0)
