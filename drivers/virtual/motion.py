"""What torque the amplifier produces: modes of operation, halt, stops, and the way from demand to power stage.

Between the power machine (which says whether to follow, stop or cut) and the joint. In cyclic synchronous torque the
target acts at once; the other modes and every stop run on the servo tick.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from servod.common.units import NS_PER_S, PER_MILLE, TWO_PI
from servod.drivers.virtual.dictionary import DeviceDictionary
from servod.drivers.virtual.joint import Joint
from servod.drivers.virtual.motor_sensor import MotorSensor
from servod.drivers.virtual.power_state import Ramp
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.cia import Obj402
from servod.runtime.fieldbus.devices import Mode

# --- The inner loops -------------------------------------------------------------------------------------------------
# The amplifier's own inner loops: velocity control, position control, set-point profile, braking. Used outside cyclic
# synchronous torque: in csv, csp and pp, and for every stop that the drive makes by itself. They run on the drive's
# servo tick, in SI units of the joint.


TICK_NS = 500_000
TICK_S = TICK_NS / NS_PER_S
_VELOCITY_BANDWIDTH = TWO_PI * 60.0  # 1/s
_INTEGRAL_RATE = 100.0  # 1/s
_POSITION_GAIN = 20.0  # 1/s


class VelocityLoop:
    """PI control of the velocity; tuned from the inertia that the drive was commissioned with."""

    def __init__(self, inertia: float) -> None:
        self._inertia, self._gain = inertia, inertia * _VELOCITY_BANDWIDTH
        self._integral_nm = 0.0

    def reset(self, torque_nm: float) -> None:
        """Take over at the torque now produced."""
        self._integral_nm = torque_nm

    def torque_nm(self, wanted_rad_s: float, actual_rad_s: float, limit_nm: float, wanted_rad_s2: float = 0.0) -> float:
        """One tick; the integral part stays within `limit_nm`, and still where the torque is at its limit already."""
        error = wanted_rad_s - actual_rad_s
        straight_nm = self._gain * error + self._inertia * wanted_rad_s2
        if abs(straight_nm + self._integral_nm) < limit_nm or error * self._integral_nm < 0.0:
            integral = self._integral_nm + self._gain * _INTEGRAL_RATE * error * TICK_S
            self._integral_nm = min(max(integral, -limit_nm), limit_nm)
        return self._integral_nm + straight_nm

    def brake_nm(self, actual_rad_s: float) -> float:
        """Torque of short-circuited windings: against the velocity, nothing stored."""
        return -self._gain * actual_rad_s


def position_to_velocity(error_rad: float) -> float:
    """The proportional position loop of csp and pp."""
    return _POSITION_GAIN * error_rad


class Brake:
    """A stop under way: its velocity ramp, and when it is done.

    At rest is no faster than `rest_rad_s` for `rest_s`, once the ramp has ended (0x606F, 0x6070): a load that the
    torque cannot stop is braked on.
    """

    def __init__(
        self, ramp: Ramp, velocity_rad_s: float, deceleration_rad_s2: float, rest_rad_s: float, rest_s: float
    ) -> None:
        self.ramp = ramp
        self._wanted = velocity_rad_s if ramp in (Ramp.SLOW_DOWN, Ramp.QUICK_STOP) else 0.0
        self._step = deceleration_rad_s2 * TICK_S
        self._rest_rad_s, self._rest_ticks = rest_rad_s, max(1, round(rest_s / TICK_S))
        self._quiet = 0
        self.wanted_rad_s2 = 0.0
        self.done = False

    def wanted_rad_s(self, actual_rad_s: float) -> float:
        """Advance one tick: the velocity to follow, its change in `wanted_rad_s2`. Sets `done` when the axis rests."""
        wanted = self._wanted
        self._wanted = math.copysign(max(abs(wanted) - self._step, 0.0), wanted)
        self.wanted_rad_s2 = (self._wanted - wanted) / TICK_S
        slow = self._wanted == 0.0 and abs(actual_rad_s) <= self._rest_rad_s
        self._quiet = self._quiet + 1 if slow else 0
        self.done = self.done or self._quiet >= self._rest_ticks
        return self._wanted


class Profile:
    """Set-point generator of profile position mode: a trapezoid of velocity towards `target_rad`."""

    def __init__(self, position_rad: float) -> None:
        self.position_rad = self.target_rad = position_rad
        self.velocity_rad_s = 0.0

    def advance(self, velocity_rad_s: float, acceleration_rad_s2: float, deceleration_rad_s2: float) -> None:
        """One tick with the limits of 0x6081, 0x6083 and 0x6084."""
        left = self.target_rad - self.position_rad
        allowed = min(velocity_rad_s, math.sqrt(2.0 * deceleration_rad_s2 * abs(left)), abs(left) / TICK_S)
        wanted = math.copysign(allowed, left)
        step = acceleration_rad_s2 * TICK_S if abs(wanted) > abs(self.velocity_rad_s) else math.inf
        self.velocity_rad_s += min(max(wanted - self.velocity_rad_s, -step), step)
        self.position_rad += self.velocity_rad_s * TICK_S

    @property
    def reached(self) -> bool:
        """True when the generator stands at its target."""
        return self.position_rad == self.target_rad or abs(self.target_rad - self.position_rad) < 1e-9


# --- Torque limits and motor protection ------------------------------------------------------------------------------
# The amplifier's own torque limits, in the order of the standard, and its motor protection. Between the torque demand
# of any mode and the power stage. Everything in per mille of rated torque; torque and current are taken as
# proportional, as in a synchronous motor below field weakening.


RATED_PERMILLE = 1000
#: Thermal reserve: (torque/rated)^2 - 1, integrated over time in s; at this much the torque falls back to rated.
THERMAL_RESERVE_S = 20.0


class TorqueLimits:
    """Clamps a demand; `limited` says whether the last one was changed (status word bit 11)."""

    def __init__(self, dictionary: DeviceDictionary) -> None:
        entry = dictionary.entry
        self._max_torque = entry(Obj402.MAX_TORQUE)
        self._positive = entry(Obj402.POSITIVE_TORQUE_LIMIT)
        self._negative = entry(Obj402.NEGATIVE_TORQUE_LIMIT)
        self._max_current = entry(Obj402.MAX_CURRENT)
        self._max_speed = entry(Obj402.MAX_MOTOR_SPEED)
        self._heat_s = 0.0
        self._folded_back = False
        self.limited = False

    @property
    def hot(self) -> bool:
        """True while the motor protection holds the torque at its rated value (warning, status word bit 7)."""
        return self._folded_back

    def clamp(self, demand: float, motor_speed_rpm: float, stopping: bool, outward: float = 0.0) -> int:
        """The torque produced: 0x6072, then 0x60E0/0x60E1 and 0x607D (not in a quick stop), 0x6073, thermal, speed.

        `outward`: the sense of torque that drives further beyond a position limit, 0 within.
        """
        high = low = self._max_torque.value
        if not stopping:
            high = min(high, self._positive.value)
            low = min(low, self._negative.value)
            if outward > 0.0:
                high = 0
            elif outward < 0.0:
                low = 0
        current = RATED_PERMILLE if self._folded_back else self._max_current.value
        high, low = min(high, current), min(low, current)
        speed = self._max_speed.value
        if motor_speed_rpm > speed:
            high = 0
        elif motor_speed_rpm < -speed:
            low = 0
        wanted = round(demand)
        produced = high if wanted > high else -low if wanted < -low else wanted
        self.limited = produced != wanted
        return produced

    def warm(self, produced: int, duration_s: float) -> None:
        """Account `duration_s` at `produced` for the motor protection."""
        ratio = produced / RATED_PERMILLE
        self._heat_s += (ratio * ratio - 1.0) * duration_s
        if self._heat_s <= 0.0:
            self._heat_s = 0.0
            self._folded_back = False
        elif self._heat_s >= THERMAL_RESERVE_S:
            self._folded_back = True


_POLARITY_TORQUE = 0x20
_HALT, _NEW_SET_POINT, _RELATIVE = 0x100, 0x10, 0x40
_DECELERATION = {Ramp.SLOW_DOWN: 0x6084, Ramp.QUICK_STOP: 0x6085}
_MNM_PER_NM, _MS_PER_S = 1000.0, 1000.0
CYCLIC = (Mode.CYCLIC_SYNC_TORQUE, Mode.CYCLIC_SYNC_VELOCITY, Mode.CYCLIC_SYNC_POSITION)


class TorqueStage:
    """Torque production. `stopped(time_ns)` is called once when a stop that was asked for is done."""

    def __init__(
        self,
        dictionary: DeviceDictionary,
        joint: Joint,
        sensor: MotorSensor,
        timeline: Timeline,
        stopped: Callable[[int], None],
    ) -> None:
        self._dictionary, self._joint, self._sensor, self._stopped = dictionary, joint, sensor, stopped
        self.limits = TorqueLimits(dictionary)
        self._loop = VelocityLoop(joint.inertia)
        self._tick = timeline.timer(self._ticked)
        entry = dictionary.entry
        self._target_torque, self._torque_offset = entry(Obj402.TARGET_TORQUE), entry(Obj402.TORQUE_OFFSET)
        self._target_position, self._target_velocity = entry(Obj402.TARGET_POSITION), entry(Obj402.TARGET_VELOCITY)
        self._position_offset, self._velocity_offset = entry(0x60B0), entry(0x60B1)
        self._ends = entry(Obj402.POSITION_LIMITS, 1), entry(Obj402.POSITION_LIMITS, 2)
        self.mode = Mode.NONE
        self.following = False  # the target values count
        self.halted = False
        self.demand = 0.0  # per mille, before the limits
        self.produced = 0  # per mille
        self.position_demand_rad = 0.0
        self.velocity_demand_rad_s = 0.0
        self._brake: Brake | None = None
        self._profile = Profile(0.0)
        self._latched_rad: float | None = None
        self._feed_rad_s = 0.0
        self._control_word = 0
        self._produced_ns = 0
        self.nm_per_permille = 0.0
        self.scale()

    def scale(self) -> None:
        """Take over rated torque and polarity; per mille are of the motor, N*m of the joint behind the gear."""
        sign = -1.0 if self._dictionary.value(Obj402.POLARITY) & _POLARITY_TORQUE else 1.0
        rated_nm = self._dictionary.value(Obj402.RATED_TORQUE) / _MNM_PER_NM * self._sensor.gear_ratio
        self.nm_per_permille = sign * rated_nm / PER_MILLE

    @property
    def reached(self) -> bool:
        """Status word bit 10: a halt has come to rest, or a profile has arrived."""
        if self.halted:
            return self._brake is not None and self._brake.done
        return self.following and self.mode is Mode.PROFILE_POSITION and self._profile.reached

    @property
    def follows(self) -> bool:
        """Status word bit 12: the drive follows the command value (in pp: set-point acknowledged)."""
        if self.mode is Mode.PROFILE_POSITION:
            return bool(self._control_word & _NEW_SET_POINT)
        return self.following and self._brake is None and self.mode in CYCLIC

    def energise(self, time_ns: int) -> None:
        """Follow the target values of the present mode."""
        self.following, self._brake = True, None
        self._enter_mode(time_ns)
        if self.halted:
            self._begin_brake(Ramp(self._dictionary.value(Obj402.HALT_OPTION)), time_ns)

    def cut(self, time_ns: int) -> None:
        """No torque."""
        self.following, self._brake = False, None
        self._tick.cancel()
        self._produce(0.0, time_ns)

    def stop(self, ramp: Ramp, time_ns: int) -> None:
        """Brake to rest and hold there."""
        self.following = False
        self._begin_brake(ramp, time_ns)

    def set_mode(self, mode: Mode, time_ns: int) -> None:
        """Change the mode; the inner loops take over at the torque now produced."""
        self.mode = mode
        if self.following and self._brake is None:
            self._enter_mode(time_ns)

    def control(self, word: int, time_ns: int) -> None:
        """Mode-specific bits and halt of the control word."""
        edges, self._control_word = word & ~self._control_word, word
        if edges & _NEW_SET_POINT and self.mode is Mode.PROFILE_POSITION and self.following:
            base = self._profile.target_rad if word & _RELATIVE else 0.0
            self._profile.target_rad = base + self._target_position.value / self._sensor.user_per_rad
        halted = bool(word & _HALT)
        if halted is not self.halted:
            self.halted = halted
            if self.following:
                self.energise(time_ns)

    def targets(self, time_ns: int) -> None:
        """New target values came (at SYNC, or written)."""
        if not self.following or self._brake is not None:
            return
        if self.mode is Mode.CYCLIC_SYNC_TORQUE:
            self._produce(self._target_torque.value + self._torque_offset.value, time_ns)
        elif self.mode is Mode.CYCLIC_SYNC_POSITION:
            self._latch_position()

    def _latch_position(self) -> None:
        """Target of csp, and the velocity that its change means."""
        target = (self._target_position.value + self._position_offset.value) / self._sensor.user_per_rad
        if self._latched_rad is not None:
            value = self._dictionary.value
            period_s = value(Obj402.INTERPOLATION_PERIOD, 1) * 10.0 ** value(Obj402.INTERPOLATION_PERIOD, 2)
            self._feed_rad_s = (target - self._latched_rad) / period_s
        self._latched_rad = target

    def _enter_mode(self, time_ns: int) -> None:
        self._loop.reset(self._joint.torque_nm)
        self._profile = Profile(self._sensor.position_rad())
        self._latched_rad, self._feed_rad_s = None, 0.0
        if self.mode is Mode.CYCLIC_SYNC_TORQUE:
            self._tick.cancel()
        else:
            self._tick.arm(time_ns + TICK_NS)
        self.targets(time_ns)

    def _begin_brake(self, ramp: Ramp, time_ns: int) -> None:
        """Start the stop; with the current limit, the ramp is as steep as the torque allows."""
        velocity = self._sensor.velocity_rad_s
        deceleration = self._dictionary.value(_DECELERATION.get(ramp, 0x6085)) / abs(self._sensor.user_per_rad)
        value = self._dictionary.value
        resolution = 2.0 / (self._sensor.counts_per_rad * TICK_S)
        rest_rad_s = max(value(Obj402.VELOCITY_THRESHOLD) / abs(self._sensor.user_per_rad), resolution)
        rest_s = value(Obj402.VELOCITY_THRESHOLD_TIME) / _MS_PER_S
        self._brake = Brake(ramp, velocity, deceleration, rest_rad_s, rest_s)
        self._loop.reset(0.0)  # what the joint was driven with is no part of a stop
        self._tick.arm(time_ns + TICK_NS)

    def _ticked(self, time_ns: int) -> None:
        """One servo tick."""
        self._tick.arm(time_ns + TICK_NS)
        self._sensor.sample(time_ns)
        limit_nm = self._dictionary.value(Obj402.MAX_TORQUE) * abs(self.nm_per_permille)
        if self._brake is not None:
            self._brake_tick(self._brake, limit_nm, time_ns)
        elif self.following:
            wanted = self._wanted_velocity()
            self.velocity_demand_rad_s = wanted
            torque = self._loop.torque_nm(wanted, self._sensor.velocity_rad_s, limit_nm)
            self._produce(torque / self.nm_per_permille + self._torque_offset.value, time_ns)

    def _brake_tick(self, brake: Brake, limit_nm: float, time_ns: int) -> None:
        was_done, actual = brake.done, self._sensor.velocity_rad_s
        wanted = brake.wanted_rad_s(actual)
        if brake.ramp is Ramp.VOLTAGE_LIMIT:
            torque = self._loop.brake_nm(actual)
        else:
            torque = self._loop.torque_nm(wanted, actual, limit_nm, brake.wanted_rad_s2)
        self._produce(torque / self.nm_per_permille, time_ns)
        if brake.done and not was_done and not self.following:
            self._stopped(time_ns)
        elif brake.done and not was_done and not self.halted:
            self.energise(time_ns)

    def _wanted_velocity(self) -> float:
        """Velocity that the present mode wants now [rad/s]; no mode wants rest."""
        user_per_rad = self._sensor.user_per_rad
        offset = self._velocity_offset.value / user_per_rad
        if self.mode is Mode.CYCLIC_SYNC_VELOCITY:
            return self._target_velocity.value / user_per_rad + offset
        position = self._sensor.position_rad()
        if self.mode is Mode.CYCLIC_SYNC_POSITION and self._latched_rad is not None:
            self.position_demand_rad = self._latched_rad
            return position_to_velocity(self._latched_rad - position) + self._feed_rad_s + offset
        if self.mode is Mode.PROFILE_POSITION:
            value = self._dictionary.value
            scale = abs(user_per_rad)
            self._profile.advance(value(0x6081) / scale, value(0x6083) / scale, value(0x6084) / scale)
            self.position_demand_rad = self._profile.position_rad
            return position_to_velocity(self._profile.position_rad - position) + self._profile.velocity_rad_s
        return 0.0

    def _outward(self) -> float:
        """Which torque leads further beyond 0x607D."""
        per_count = self._sensor.user_per_count
        position, (lowest, highest) = self._sensor.counts * per_count, self._ends
        side = (position > highest.value) - (position < lowest.value)
        return side * per_count * self.nm_per_permille

    def _produce(self, demand: float, time_ns: int) -> None:
        """The last step of every mode: limits, then the power stage."""
        self.limits.warm(self.produced, (time_ns - self._produced_ns) / 1e9 if self._produced_ns else 0.0)
        self._produced_ns = time_ns
        self.demand = demand
        self.produced = self.limits.clamp(demand, self._sensor.speed_rpm, not self.following, self._outward())
        self._joint.command(self.produced * self.nm_per_permille, time_ns)
