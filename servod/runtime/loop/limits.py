"""Limits: the last word before the wire. They trust neither the controller nor the configuration of the drive.

One call per cycle, after the controller and before the driver. Finite numbers are checked before anything is clamped,
because min() and max() turn NaN into a limit value. What each fault does to the axis stands in
servod.common.faults.FAULTS.
"""

from __future__ import annotations

import math

from servod.common.faults import FAULTS, FaultCode
from servod.formats.config import LimitsConfig
from servod.kernels.holding import Holding, Proof
from servod.kernels.stopping import StopFacts, Way, both_ways
from servod.runtime.fieldbus.cia import SW_INTERNAL_LIMIT
from servod.runtime.fieldbus.devices import NEVER_CYCLES, AmplifierFeedback, EncoderFeedback

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
_BENT_TORQUE = _BIT[FaultCode.TORQUE_IMPLAUSIBLE]


#: The test of the wiring ends itself beyond its travel; where it does not, the limits do beyond this multiple of it.
PROVING_TRAVELS = 2.0
#: Skipped periods that one punctual cycle makes up for: a single good cycle does not forgive a starving machine.
_FORGIVEN_PER_CYCLE = 0.05
#: The speed that the drive's own sensor shows is low-passed with this time constant, as the encoder's is.
_MOTOR_SPEED_S = 2e-3
#: The drive's torque is held against the commands of so many cycles, which is what its current loop and the wire take.
_MEMORY_CYCLES = 20
#: A torque that is bent in so many cycles in a row is no disturbance.
_MOST_BENT_CYCLES = 50
#: Of limits.torque_nm, where limits.torque_mismatch_nm is left out.
_MISMATCH_SHARE = 0.25
#: Above this share of the speed limit a joint counts as moving.
_MOVING_SHARE = 0.01
#: Above this one it is not let go after a stop under control.
_LET_GO_SHARE = 0.03
#: From this share of the speed limit on a joint moves towards an end, and its load may slow it down.
_MOVES_SHARE = 0.1


class Limits:
    """Limits of one axis; holds the last torque, the encoder offset at enable and how late the loop has been."""

    def __init__(self, config: LimitsConfig, stop: StopFacts | None = None) -> None:
        """Copies the numbers out of `config`, so that the cycle touches plain floats only.

        With `stop` torque and position are limited so that the joint rests inside its range, and no faster than its
        speed limit allows, should nobody command it from now on (`look`).
        """
        self.torque_nm = config.torque_nm
        self.torque_rate_nm_per_s = config.torque_rate_nm_per_s
        self.speed_rad_s = config.speed_rad_s
        self.position_min_rad, self.position_max_rad = config.position_min_rad, config.position_max_rad
        self.following_error_rad = config.following_error_rad
        self.encoder_mismatch_rad = config.encoder_mismatch_rad
        self.stale_cycles, self.late_cycles = config.stale_cycles, config.late_cycles
        mismatch_nm = config.torque_mismatch_nm
        self.torque_mismatch_nm = _MISMATCH_SHARE * config.torque_nm if mismatch_nm is None else mismatch_nm
        self._forgets_nm = config.torque_nm / _MEMORY_CYCLES  # in each cycle
        self._most_commanded_nm = self._least_commanded_nm = 0.0
        self._bent_cycles = self._apart_cycles = 0
        self._last_torque_nm = self._dt_s = 0.0
        self._encoder_offset_rad = self._armed_at_rad = 0.0
        self._late_level = 0.0
        self._ways = None if stop is None else both_ways(stop)
        self._holding = None if stop is None else Holding(stop)
        self._motor_rad, self._motor_rad_s, self._motor_s = math.nan, 0.0, 0.0
        self._least_nm, self._most_nm, self._near_end = -math.inf, math.inf, False

    @property
    def at_rest_nm(self) -> float:
        """Half of the range of torque that a joint at rest in the middle of its travel may have [N*m]."""
        if self._ways is None:
            return self.torque_nm
        up, down = (min(self.torque_nm, way.most_torque_nm(0.0, math.inf)) for way in self._ways)
        return 0.5 * (up + down)

    def look(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback, dt_s: float) -> None:
        """Where the joint stands in this cycle and how fast it is: what torque it may have, and whether it must stop.

        The faster of both sensors counts, each way: one of them may stand still. What was not heard is reckoned with
        the last torque, the load and the least inertia.
        """
        self._dt_s = dt_s
        if self._ways is None or self._holding is None:
            return
        up, down = self._ways
        self._motor_s += dt_s  # since the drive was heard last: its way is that of all cycles that were lost
        if amplifier.age_cycles == 0:
            change_rad, over_s = amplifier.position_rad - self._motor_rad, self._motor_s
            self._motor_rad, self._motor_s = amplifier.position_rad, 0.0
            if math.isfinite(change_rad):
                self._motor_rad_s += (change_rad / over_s - self._motor_rad_s) * over_s / (over_s + _MOTOR_SPEED_S)
        unheard_s = max(amplifier.age_cycles, encoder.age_cycles) * dt_s if amplifier.age_cycles < NEVER_CYCLES else 0.0
        gained_rad_s = (abs(self._last_torque_nm) + up.facts.load_nm) / up.facts.least_inertia * unheard_s
        fast_rad_s = max(encoder.velocity_rad_s, self._motor_rad_s) + gained_rad_s
        slow_rad_s = min(encoder.velocity_rad_s, self._motor_rad_s) - gained_rad_s
        ahead_rad = self.position_max_rad - encoder.position_rad - max(fast_rad_s, 0.0) * unheard_s
        behind_rad = encoder.position_rad - self.position_min_rad - max(-slow_rad_s, 0.0) * unheard_s
        self._most_nm = up.most_torque_nm(fast_rad_s, ahead_rad)
        self._least_nm = -down.most_torque_nm(-slow_rad_s, behind_rad)
        heard = encoder.age_cycles == 0
        proof = self._holding.look(encoder.position_rad, self._last_torque_nm, dt_s, heard)
        self._leave_what_holds((fast_rad_s, -slow_rad_s), (ahead_rad, behind_rad), proof, self._ways)
        self._near_end = up.too_near(fast_rad_s, ahead_rad) or down.too_near(-slow_rad_s, behind_rad)

    def _leave_what_holds(
        self, speeds_rad_s: tuple[float, float], rooms_rad: tuple[float, float], proof: Proof, ways: tuple[Way, Way]
    ) -> None:
        """The end of the range takes no torque away that a load is proven to take: that would let it fall.

        What may hang on the joint need not: without proof the joint could leave its range by the torque for it.
        """
        up, down = ways
        rests_up = self._rests(max(speeds_rad_s[0], proof.speed_rad_s))
        rests_down = self._rests(max(speeds_rad_s[1], -proof.speed_rad_s))
        held_up_nm, held_down_nm = rests_up * proof.up_nm, rests_down * proof.down_nm
        if held_up_nm:
            self._most_nm = max(self._most_nm, up.most_held_nm(held_up_nm, speeds_rad_s[0], rooms_rad[0]))
        if held_down_nm:
            self._least_nm = min(self._least_nm, -down.most_held_nm(held_down_nm, speeds_rad_s[1], rooms_rad[1]))

    def _rests(self, speed_rad_s: float) -> float:
        """1 for a joint that does not move this way, 0 for one that does, which its load may slow down."""
        left = (_MOVES_SHARE - speed_rad_s / self.speed_rad_s) / (_MOVES_SHARE - _MOVING_SHARE)
        return min(1.0, max(0.0, left))

    def arm(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback, commanded_nm: float) -> None:
        """At enable: both position sensors agree by definition now; torque starts from what the drive was told last.

        What it shows (0x6077) may be wrong, and must not become torque: `torque_faults` judges it.
        """
        self._encoder_offset_rad = amplifier.position_rad - encoder.position_rad
        self._armed_at_rad = encoder.position_rad
        self._last_torque_nm = commanded_nm
        self._most_commanded_nm = self._least_commanded_nm = self._last_torque_nm
        self._bent_cycles = self._apart_cycles = 0
        if self._holding is not None:
            still = abs(encoder.velocity_rad_s) <= _MOVING_SHARE * self.speed_rad_s
            self._holding.begin(encoder.position_rad, self._last_torque_nm if still else 0.0)

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
        if self._near_end or not self.position_min_rad <= position <= self.position_max_rad:
            faults |= _POSITION
        if reference_rad is not None and not abs(reference_rad - position) <= self.following_error_rad:
            faults |= _FOLLOWING
        if not self._sensors_agree(amplifier, encoder):
            faults |= _MISMATCH
        return faults

    def _sensors_agree(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback) -> bool:
        """Whether both position sensors do, as far as one can tell.

        Positions of two moments differ in motion: that waits for frames of one moment, but no longer than feedback may
        be away; then what the joint can have moved between them is allowed.
        """
        apart_cycles = abs(amplifier.age_cycles - encoder.age_cycles)
        self._apart_cycles = self._apart_cycles + 1 if apart_cycles else 0
        if 0 < self._apart_cycles <= self.stale_cycles:
            return True
        difference_rad = abs(amplifier.position_rad - encoder.position_rad - self._encoder_offset_rad)
        return difference_rad <= self.encoder_mismatch_rad + apart_cycles * self._dt_s * self.speed_rad_s

    def proving_faults(self, encoder: EncoderFeedback, most_travel_rad: float) -> int:
        """While the wiring is tested: the joint stays near where the test began, whatever the test thinks of it."""
        near = abs(encoder.position_rad - self._armed_at_rad) <= PROVING_TRAVELS * most_travel_rad
        return 0 if near else _NOT_PROVEN

    def torque_faults(self, amplifier: AmplifierFeedback) -> int:
        """A drive that says it gives another torque than it was told in the last cycles; one that says that it limits
        the torque may give less, down to none."""
        if amplifier.age_cycles:
            return 0
        most_nm, least_nm = self._most_commanded_nm, self._least_commanded_nm
        if amplifier.status_word & SW_INTERNAL_LIMIT:
            most_nm, least_nm = max(most_nm, 0.0), min(least_nm, 0.0)
        above_nm, below_nm = amplifier.torque_nm - most_nm, least_nm - amplifier.torque_nm
        bent = above_nm > self.torque_mismatch_nm or below_nm > self.torque_mismatch_nm
        self._bent_cycles = self._bent_cycles + 1 if bent else 0
        return _BENT_TORQUE if self._bent_cycles >= _MOST_BENT_CYCLES else 0

    def limit_torque(self, wanted_nm: float, dt_s: float) -> tuple[float, int]:
        """The torque that may go out, and fault bits of what was limited. Not finite gives zero."""
        if not (math.isfinite(wanted_nm) and math.isfinite(dt_s)):
            self._last_torque_nm = 0.0
            return 0.0, _NOT_FINITE
        faults, torque_nm = 0, wanted_nm
        step_nm = self.torque_rate_nm_per_s * dt_s
        change_nm = wanted_nm - self._last_torque_nm
        if abs(change_nm) > step_nm:
            torque_nm = self._last_torque_nm + math.copysign(step_nm, change_nm)
            # A step that is longer by a rounding alone gets there all the same.
            faults = _RATE if torque_nm != wanted_nm else 0
        if abs(torque_nm) > self.torque_nm:  # the torque itself has the last word, wherever the ramp began
            torque_nm, faults = math.copysign(self.torque_nm, torque_nm), faults | _CLIPPED
        if not self._least_nm <= torque_nm <= self._most_nm:
            torque_nm, faults = min(max(torque_nm, self._least_nm), self._most_nm), faults | _CLIPPED
        self._last_torque_nm = torque_nm
        self._most_commanded_nm = max(torque_nm, self._most_commanded_nm - self._forgets_nm)
        self._least_commanded_nm = min(torque_nm, self._least_commanded_nm + self._forgets_nm)
        return torque_nm, faults

    def ramp(self, from_nm: float, share: float, velocity_rad_s: float) -> float:
        """Torque of a ramp-down: `share` of what there was, and nothing of a torque that drives the joint on.

        The torque that a failed motion ends with may be the one that does the harm (a wrong polarity); only braking
        and holding torque is taken away slowly.
        """
        drives = from_nm * velocity_rad_s > 0.0 and abs(velocity_rad_s) > _MOVING_SHARE * self.speed_rad_s
        return 0.0 if drives else from_nm * share

    def moving(self, encoder: EncoderFeedback) -> bool:
        """The joint is too fast to be let go: it would coast on."""
        return abs(encoder.velocity_rad_s) > _LET_GO_SHARE * self.speed_rad_s

    def release(self) -> None:
        """The axis produces no torque: the next ramp starts from zero."""
        self._last_torque_nm = 0.0

    def _deadline_faults(self, skipped: int) -> int:
        self._late_level = max(0.0, self._late_level + skipped - _FORGIVEN_PER_CYCLE)
        late = _LATE if skipped else 0
        return late | (_BUDGET if self._late_level > self.late_cycles else 0)
