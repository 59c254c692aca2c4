"""The bounded test of the wiring before the first torque: polarity, scale and directions, as a state machine on floats.

Runs in the loop in place of the controller while the axis is PROVING; axis and limits stand above it as above every
torque. REST: no torque, the joint must stand. PUSH: the torque grows exponentially from next to nothing until the joint
has moved by a stated small travel, towards the middle of its range first. SETTLE: the torque ends, and brakes what
friction does not stop, once the signs are known. Then PUSH and SETTLE the other way; both together tell friction from a
constant load, and bring the joint back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum

from servod.runtime.fieldbus.devices import AmplifierFeedback, EncoderFeedback
from servod.runtime.loop.wiring import checks as judge
from servod.runtime.loop.wiring.checks import (
    REST_CYCLES,
    SPEED_CYCLES,
    CheckResult,
    Push,
    RestWindow,
    TorqueLine,
    WiringTestBounds,
)
from servod.runtime.loop.wiring.findings import WiringOutcome, WiringReport

#: The joint must stand within this time, before the first push and after each.
_REST_S, _SETTLE_S = 0.5, 0.5
#: After a push it stands when it has not moved for REST_CYCLES without torque; the last torque acts so much later.
_DELAY_CYCLES = 10
#: The most torque is held so long before the joint counts as blocked, or twice as long while it creeps.
_HOLD_S = 0.15
#: Cycles without feedback over which the torque is held; then it ends and the push is done again.
_HELD_CYCLES = 2
#: The ramp grows by no more than this many periods at once, however late the cycle is.
_LATE_PERIODS = 2.0
#: Standing still: so many counts, this share of the travel, and this multiple of the sensor's noise.
_STILL_COUNTS, _STILL_SHARE, _STILL_NOISES = 1.5, 0.05, 4.0
#: A joint that does not slow down by itself this long after the end of a push (delay of the torque, and time to see it)
#: is braked. The torque begins at this share of what the push ended with, grows by e in this time, and begins with half
#: as much after each change of direction.
_COAST_S, _BRAKE_SHARE, _BRAKE_GROWTH_S = 0.007, 0.3, 0.01
#: Travel over the sensor's noise.
_TRAVEL_NOISES = 14.0


class _Stage(IntEnum):
    REST = 0
    PUSH = 1
    SETTLE = 2


class WiringTest:
    """The test of one axis; `step` once per cycle while it runs, `verdict` when it is over."""

    def __init__(self, bounds: WiringTestBounds) -> None:
        """Nothing is proven yet."""
        self._bounds = bounds
        self.proven = False
        self.running = False
        self.verdict: CheckResult | None = None
        self._stages: dict[_Stage, Callable[[float], CheckResult | None]] = {
            _Stage.REST: self._rest,
            _Stage.PUSH: self._ramp,
            _Stage.SETTLE: self._settle,
        }
        self.begin(0.0, 0.0)
        self.running = False

    def begin(self, encoder_rad: float, amplifier_rad: float) -> None:
        """Start from where both sensors stand."""
        self.running, self.verdict = True, None
        self._time_s = self._stage_s = self._hold_s = 0.0
        self._stage = _Stage.REST
        self._window = RestWindow(encoder_rad, 0.0)
        self._start_rad = self._encoder_rad = encoder_rad
        self._amplifier_rad = amplifier_rad
        self._noise_rad = self._travel_rad = self._fastest_rad_s = 0.0
        self._torque_nm = 0.0  # magnitude of the ramp, or of the brake
        self._wanted_nm = 0.0
        self._brake_first_nm = self._brake_direction = 0.0
        self._line = TorqueLine()
        self._shown_nm = 0.0  # sum of 0x6077 over the cycles before the first push
        self._pushes: list[Push] = []  # at most two
        self._signs_known = self._repeat = False
        self._quiet_cycles = 0  # without torque, in a row
        self._stale_cycles = 0
        self._ratio = math.nan

    def forget(self) -> None:
        """Nothing is proven any more; the next cycle of the axis in PROVING begins again."""
        self.proven, self.running, self.verdict = False, False, None

    def step(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback, demand_nm: float, dt_s: float) -> float:
        """One cycle: the torque that goes out now, N*m. `demand_nm`: what went out in the last one."""
        self._time_s += dt_s
        self._stage_s += dt_s
        if self._time_s > self._bounds.timeout_s:
            return self._end(CheckResult(WiringOutcome.TIMEOUT, self._time_s, 0.0, self._bounds.timeout_s))
        if amplifier.age_cycles or encoder.age_cycles:
            return self._without_feedback(dt_s)
        self._stale_cycles = 0
        self._see(amplifier, encoder, demand_nm)
        verdict = self._breach() or self._stages[self._stage](min(dt_s, _LATE_PERIODS * self._bounds.period_s))
        return self._end(verdict) if verdict is not None else self._slew(dt_s)

    def interrupt(self) -> None:
        """Ended from outside, by a fault or a command; what was seen so far may still tell why."""
        self._end(self._so_far() or CheckResult(WiringOutcome.INTERRUPTED))

    def report(self) -> WiringReport:
        """The figures of the last test."""
        verdict = self.verdict or CheckResult(WiringOutcome.INTERRUPTED)
        return WiringReport(
            *verdict,
            self._break_away_nm(1.0), self._break_away_nm(-1.0), self._ratio, self._line.slope, self._travel_rad,
            self._encoder_rad - self._start_rad, self._fastest_rad_s, self._noise_rad, self._time_s,
            self._bounds.friction_nm, judge.scale_factor(self._bounds),
        )  # fmt: skip

    # --- one cycle -------------------------------------------------------------------------------------------------
    def _see(self, amplifier: AmplifierFeedback, encoder: EncoderFeedback, demand_nm: float) -> None:
        self._encoder_rad, self._amplifier_rad = encoder.position_rad, amplifier.position_rad
        self._window.add(encoder.position_rad, self._time_s)
        self._travel_rad = max(self._travel_rad, abs(encoder.position_rad - self._start_rad))
        self._fastest_rad_s = max(self._fastest_rad_s, abs(self._window.speed_rad_s()))
        if self._pushes:
            self._pushes[-1].see(encoder.position_rad, amplifier.position_rad)
        else:
            self._shown_nm += amplifier.torque_nm
        if self._stage == _Stage.PUSH:
            self._line.add(demand_nm, amplifier.torque_nm)
            push = self._pushes[-1]
            push.commanded_nm = max(push.commanded_nm, push.sign * demand_nm)

    def _breach(self) -> CheckResult | None:
        """Further or faster than allowed; what was seen so far may say why."""
        bounds, verdict = self._bounds, None
        if self._travel_rad > bounds.most_travel_rad:
            verdict = CheckResult(WiringOutcome.TRAVEL, self._travel_rad, 0.0, bounds.most_travel_rad)
        elif self._fastest_rad_s > bounds.most_rad_s + bounds.encoder_count_rad / (SPEED_CYCLES * bounds.period_s):
            verdict = CheckResult(WiringOutcome.SPEED, self._fastest_rad_s, 0.0, bounds.most_rad_s)
        return verdict and (self._so_far() or verdict)

    def _without_feedback(self, dt_s: float) -> float:
        """Hold the torque for a moment; then none, and the push is done again when there is feedback."""
        self._stale_cycles += 1
        if self._stale_cycles <= _HELD_CYCLES:
            return self._wanted_nm
        if self._stage == _Stage.PUSH:
            self._repeat = True
            self._enter(_Stage.SETTLE)
        self._torque_nm = 0.0
        return self._slew(dt_s)

    def _slew(self, dt_s: float) -> float:
        """The torque of the stage, no faster than the rate that the limits allow."""
        step_nm = self._bounds.rate_nm_per_s * min(dt_s, self._bounds.period_s)
        wanted_nm = self._direction() * self._torque_nm
        self._wanted_nm += min(max(wanted_nm - self._wanted_nm, -step_nm), step_nm)
        return self._wanted_nm

    def _direction(self) -> float:
        return self._pushes[-1].sign if self._stage == _Stage.PUSH else -self._brake_direction

    def _end(self, verdict: CheckResult) -> float:
        self.verdict, self.running = verdict, False
        self.proven = verdict.finding == WiringOutcome.PASSED
        self._torque_nm = self._wanted_nm = 0.0
        return 0.0

    def _enter(self, stage: _Stage) -> None:
        self._stage, self._stage_s, self._torque_nm = stage, 0.0, 0.0
        self._hold_s = self._brake_direction = 0.0
        self._quiet_cycles = 0

    # --- the stages ------------------------------------------------------------------------------------------------
    def _rest(self, _dt_s: float) -> CheckResult | None:
        """No torque yet: plausible sizes, and a joint that stands."""
        if verdict := judge.rated_torque(self._bounds):
            return verdict
        if self._window.count <= REST_CYCLES:
            return None
        if verdict := judge.torque_at_rest(self._shown_nm / self._window.count, self._bounds):
            return verdict
        self._noise_rad = self._window.step_rad()
        late = self._stage_s > _REST_S
        if self._creeps() and not late:
            return self._moves_alone(0.5 * self._bounds.most_travel_rad)
        if late and (verdict := self._moves_alone(self._bounds.travel_rad)):
            return verdict
        self._push(1.0 if self._encoder_rad <= self._bounds.middle_rad else -1.0)
        return None

    def _moves_alone(self, allowed_rad: float) -> CheckResult | None:
        moved_rad = self._encoder_rad - self._start_rad
        return (
            CheckResult(WiringOutcome.NOT_AT_REST, moved_rad, 0.0, allowed_rad)
            if abs(moved_rad) > allowed_rad
            else None
        )

    def _push(self, sign: float) -> None:
        self._enter(_Stage.PUSH)
        self._torque_nm = self._bounds.first_nm
        self._pushes.append(Push(sign, self._window.mean_rad(), self._amplifier_rad))

    def _ramp(self, dt_s: float) -> CheckResult | None:
        """More torque, until the joint has moved or the most was held for its time."""
        bounds, push = self._bounds, self._pushes[-1]
        encoder, amplifier = push.ways(self._encoder_rad, self._amplifier_rad)
        if self._signs_known and encoder < 0.0:  # still drifting back: the way counts from where it turns
            push.begin_way(self._encoder_rad, self._amplifier_rad)
        if not push.began and abs(encoder) > self._began_rad():
            push.begin_motion(self._torque_nm, self._time_s, self._encoder_rad, self._amplifier_rad)
        if self._moved(abs(encoder), abs(amplifier)):
            return self._cut(push)
        if not (push.began and self._creeps()):  # more torque would only make it faster
            self._torque_nm = min(bounds.most_nm, self._torque_nm * math.exp(dt_s * bounds.growth_per_s))
        if self._torque_nm >= bounds.most_nm:
            self._hold_s += dt_s
            if self._hold_s > _HOLD_S * (2.0 if self._creeps() else 1.0):
                return self._blocked()
        return None

    def _moved(self, encoder: float, amplifier: float) -> bool:
        """Both sensors moved, or one of them so far that slack cannot be the reason."""
        travel = self._travel_needed()
        both = max(encoder, amplifier) >= travel and min(encoder, amplifier) >= 0.5 * travel
        return both or max(encoder, amplifier) >= self._bounds.lone_travel_rad

    def _travel_needed(self) -> float:
        return max(self._bounds.travel_rad, _TRAVEL_NOISES * self._noise_rad)

    def _cut(self, push: Push) -> CheckResult | None:
        """The joint has moved: end the torque, and judge at once what may not go on."""
        push.cut_nm, push.cut_s = self._torque_nm, self._time_s
        if not push.began:
            push.begin_motion(self._torque_nm, self._time_s, push.encoder_rad, push.amplifier_rad)
        verdict = (
            self._sensors(self._encoder_rad, self._amplifier_rad)
            or judge.first_torque(push, self._bounds)
            or judge.energy(push, self._encoder_rad, self._bounds)
        )
        self._signs_known = verdict is None
        self._enter(_Stage.SETTLE)
        self._brake_first_nm = 2.0 * _BRAKE_SHARE * push.cut_nm
        return verdict

    def _blocked(self) -> CheckResult | None:
        """No motion under the most torque; one direction alone may be a stop, so the other is tried first."""
        if len(self._pushes) == 1:
            self._enter(_Stage.SETTLE)
            return None
        first, bounds, commanded_nm = self._pushes[0], self._bounds, self._pushes[-1].commanded_nm
        if verdict := judge.actual_torque(self._line, bounds):
            return verdict
        if not first.moved:
            return CheckResult(WiringOutcome.NO_MOTION, min(first.commanded_nm, commanded_nm))
        at_least_nm = 0.5 * (first.began_nm + commanded_nm)  # friction: the other break-away lies beyond the most
        return judge.friction(at_least_nm, bounds) or CheckResult(WiringOutcome.ONE_WAY, commanded_nm)

    def _settle(self, dt_s: float) -> CheckResult | None:
        """Brake what moves, release what stands, and go on when it has stood for its time."""
        moves = self._moves()
        if moves and self._signs_known:
            self._brake(dt_s)
        else:
            self._torque_nm = 0.0
        stands, late = self._stands(), self._stage_s > _SETTLE_S
        if late and moves:
            return CheckResult(WiringOutcome.NOT_AT_REST, self._encoder_rad - self._start_rad)
        return self._go_on() if stands or late else None

    def _stands(self) -> bool:
        """It has stood without torque for so long that a spring's way back is over: it would pass for a motion."""
        self._quiet_cycles = self._quiet_cycles + 1 if self._wanted_nm == self._torque_nm == 0.0 else 0
        return self._quiet_cycles > REST_CYCLES + _DELAY_CYCLES and not self._creeps()

    def _brake(self, dt_s: float) -> None:
        """Torque against the motion, growing while the joint does not slow down."""
        direction = math.copysign(1.0, self._window.way_rad(SPEED_CYCLES))
        if direction != self._brake_direction:
            self._torque_nm, self._brake_direction = 0.0, direction
            self._brake_first_nm *= 0.5
        if self._stage_s > _COAST_S and not self._window.slows():
            torque_nm = max(self._brake_first_nm, self._torque_nm * math.exp(dt_s / _BRAKE_GROWTH_S))
            self._torque_nm = min(self._bounds.most_nm, torque_nm)

    def _go_on(self) -> CheckResult | None:
        """The next push, or the verdict over all of them."""
        last = self._pushes[-1]
        if self._repeat:
            self._repeat = False
            self._pushes.pop()
            self._push(last.sign)
            return None
        # Where each sensor turned: further than up to the end of the torque, and no matter how late either shows it.
        if last.moved and (verdict := self._sensors(last.furthest_encoder_rad, last.furthest_amplifier_rad)):
            return verdict
        if len(self._pushes) == 1:
            self._push(-last.sign)
            return None
        return self._judge()

    # --- verdicts --------------------------------------------------------------------------------------------------
    def _judge(self) -> CheckResult:
        """Over both directions."""
        if not self._pushes[0].moved:
            return CheckResult(WiringOutcome.ONE_WAY, self._pushes[0].commanded_nm)
        friction_nm = 0.5 * (self._break_away_nm(1.0) - self._break_away_nm(-1.0))
        return (
            judge.actual_torque(self._line, self._bounds)
            or judge.friction(friction_nm, self._bounds)
            or CheckResult(WiringOutcome.PASSED)
        )

    def _sensors(self, encoder_rad: float, amplifier_rad: float) -> CheckResult | None:
        """Both sensors' ways of the present push, up to these positions."""
        push = self._pushes[-1]
        whole, late = push.ways(encoder_rad, amplifier_rad), push.late_ways(encoder_rad, amplifier_rad)
        if whole[0] != 0.0:
            self._ratio = whole[1] / whole[0]
        skew_rad = abs(self._window.way_rad(SPEED_CYCLES))
        return judge.sensors(whole, late, self._bounds, _STILL_NOISES * self._noise_rad, skew_rad)

    def _so_far(self) -> CheckResult | None:
        """What the sensors' ways of an unfinished push say, where there are any."""
        if self._stage != _Stage.PUSH:
            return None
        now = (self._encoder_rad, self._amplifier_rad)
        ways = self._pushes[-1].ways(*now)
        return self._sensors(*now) if max(abs(ways[0]), abs(ways[1])) > 0.5 * self._bounds.travel_rad else None

    def _moves(self) -> bool:
        return abs(self._window.way_rad(SPEED_CYCLES)) > self._still_rad()

    def _creeps(self) -> bool:
        return abs(self._window.way_rad(REST_CYCLES)) > self._still_rad()

    def _still_rad(self) -> float:
        bounds = self._bounds
        share = max(_STILL_COUNTS * bounds.encoder_count_rad, _STILL_SHARE * bounds.travel_rad)
        return share + _STILL_NOISES * self._noise_rad

    def _began_rad(self) -> float:
        return max(0.25 * self._travel_needed(), self._still_rad())

    def _break_away_nm(self, sign: float) -> float:
        return next((p.sign * p.began_nm for p in self._pushes if p.sign == sign and p.moved), math.nan)
