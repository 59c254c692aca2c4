"""The virtual servo amplifier: a CANopen node with the CiA 402 drive profile on a joint with friction.

Hears control word and targets, answers with status word and actual values; joins power machine, motion and faults.
"""

from __future__ import annotations

from functools import partial
from importlib.resources import files
from pathlib import Path

from servod.drivers.virtual.dictionary import DeviceDictionary, SdoRefusal
from servod.drivers.virtual.drive_record import DriveRecord
from servod.drivers.virtual.joint import Joint, JointBrake
from servod.drivers.virtual.motion import TorqueStage
from servod.drivers.virtual.motor_sensor import MotorSensor
from servod.drivers.virtual.node import Send, VirtualNode
from servod.drivers.virtual.power_state import ENERGISED, DriveCommand, PowerMachine, Ramp, status_word
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.cia import Abort, Emcy, Obj402
from servod.runtime.fieldbus.devices import DriveState, Mode

# --- Causes of faults ------------------------------------------------------------------------------------------------
# What makes the amplifier fault by itself, and whether the cause is gone: supply, STO, temperature, on demand. The
# objects 0x2000 are the vendor's: they put causes into the drive for trying.


UNDER_VOLTAGE, OVER_VOLTAGE, SAFE_TORQUE_OFF, MOTOR_TEMPERATURE = 0x3220, 0x3210, 0x5441, 0x4310
_STO_CLOSED = 1 << 17
_LOWEST_MV, _HIGHEST_MV = 18_000, 60_000
_MOTOR_LIMIT_C = 120.0
#: Error classes (high nibble of the code) after which the power stage cannot brake any more.
_UNUSABLE = (0x2, 0x3, 0x5)


class DriveFaults:
    """Reads the causes; `0x2000` sub 1 error code, 2 safe torque off, 3 supply in mV, 4 local control, 5 the state
    (servod.runtime.fieldbus.devices.DriveState) in which control words do nothing, 6 the transition that control
    words do not cause, 7 what the contacts at the digital inputs give, 24 V is 1, 8 a brake that does not open."""

    def __init__(self, dictionary: DeviceDictionary) -> None:
        self._injected = dictionary.entry(0x2000, 1)
        self._safe_torque_off = dictionary.entry(0x2000, 2)
        self._supply_mv = dictionary.entry(0x2000, 3)
        self._local = dictionary.entry(0x2000, 4)
        self._stuck = dictionary.entry(0x2000, 5)
        self._refused = dictionary.entry(0x2000, 6)
        self._contacts = dictionary.entry(0x2000, 7)
        self._brake_stuck = dictionary.entry(0x2000, 8)

    @property
    def supplied(self) -> bool:
        """True when the DC link has its voltage (status word bit 4)."""
        return self._supply_mv.value >= _LOWEST_MV

    @property
    def inhibited(self) -> bool:
        """True while safe torque off is active."""
        return bool(self._safe_torque_off.value)

    def brake_stuck(self) -> bool:
        """True while the brake does not open."""
        return bool(self._brake_stuck.value)

    @property
    def inputs(self) -> int:
        """0x60FD: the contacts; bit 17 shows besides that the STO circuit is closed."""
        return self._contacts.value & ~(_STO_CLOSED if self.inhibited else 0)

    @property
    def local(self) -> bool:
        """True while the drive takes no commands from the bus (status word bit 9 clear)."""
        return bool(self._local.value)

    def ignores(self, state: DriveState, transition: int) -> bool:
        """True when a control word shall not cause this transition from this state."""
        return self._stuck.value == state or self._refused.value == transition

    @property
    def supply_mv(self) -> int:
        """DC link voltage for 0x6079."""
        return self._supply_mv.value

    def cause(self, temperature_c: float, switched_on: bool) -> int:
        """Error code of the cause that is present now, 0 when none; supply and STO count only when switched on."""
        if self._injected.value:
            return self._injected.value
        if self._supply_mv.value > _HIGHEST_MV:
            return OVER_VOLTAGE
        if temperature_c > _MOTOR_LIMIT_C:
            return MOTOR_TEMPERATURE
        if switched_on and self.inhibited:
            return SAFE_TORQUE_OFF
        return UNDER_VOLTAGE if switched_on and not self.supplied else 0


def can_brake(code: int) -> bool:
    """False when the power stage is unusable after a fault with `code`: the torque is cut at once."""
    return code >> 12 not in _UNUSABLE


AMPLIFIER_EDS = Path(str(files("servod.drivers") / "eds" / "amplifier.eds"))
#: Set-up objects that refuse writing while the drive produces torque (08000022).
LOCKED_WHILE_ENABLED = (0x6075, 0x6076, 0x607C, 0x607E, 0x608F, 0x6090, 0x6091, 0x6092, 0x60A8, 0x60A9, 0x60AA, 0x60C2)
#: 0x6061 shows a new mode so long after 0x6060 asked for it.
MODE_CHANGE_NS = 3_000_000
#: Without SYNC the drive looks after itself, and writes its record, so often.
_WATCH_NS = 2_000_000
_ABORT_FAULT, _ABORT_DISABLE, _ABORT_QUICK_STOP = 1, 2, 3
_NO_FOLLOWING_WINDOW = 0xFFFFFFFF


def wrap_i32(value: int) -> int:
    """`value` as a 32-bit counter shows it."""
    return (value + 0x80000000 & 0xFFFFFFFF) - 0x80000000


class AmplifierNode(VirtualNode):
    """The node; `record` gets a sample at every command, tick of the watch and change of state."""

    def __init__(
        self, settings: VirtualAxisSettings, joint: Joint, timeline: Timeline, send: Send, record: DriveRecord | None
    ) -> None:
        super().__init__(AMPLIFIER_EDS, settings.amplifier_node_id, settings.amplifier_serial, timeline, send)
        self.dictionary.remove(settings.missing_objects + (["1400:5"] if settings.command_deadline == "none" else []))
        self.settings, self.joint, self._record = settings, joint, record
        entry = self.dictionary.entry
        self._apply_settings()
        self.sensor = MotorSensor(self.dictionary, joint, settings.amplifier_counts_per_turn, settings.gear_ratio)
        self.machine = PowerMachine(self)
        self.motion = TorqueStage(self.dictionary, joint, self.sensor, timeline, self._at_rest)
        self.faults = DriveFaults(self.dictionary)
        self.holding = JointBrake(settings, joint, timeline, self.faults.brake_stuck)
        self._outputs, self._outputs_mask = entry(Obj402.DIGITAL_OUTPUTS, 1), entry(Obj402.DIGITAL_OUTPUTS, 2)
        self._error = 0
        self._too_far_since_ns: int | None = None
        self._control, self._mode_wanted = entry(Obj402.CONTROL_WORD), entry(Obj402.MODE)
        self._status, self._error_code, self._mode_shown = entry(0x6041), entry(0x603F), entry(0x6061)
        self._position, self._torque, self._demand = entry(0x6064), entry(0x6077), entry(0x6074)
        self._counts, self._velocity, self._sensor_velocity = entry(0x6063), entry(0x606C), entry(0x6069)
        self._current, self._position_demand, self._following = entry(0x6078), entry(0x6062), entry(0x60F4)
        self._velocity_demand, self._internal_demand, self._effort = entry(0x606B), entry(0x60FC), entry(0x60FA)
        self._digital_inputs = entry(Obj402.DIGITAL_INPUTS)
        self._events = (self._status, self._error_code, self._mode_shown)
        self._announced = (0, 0, 0)
        self._mode_timer = timeline.timer(self._mode_taken)
        self._watch = timeline.timer(self._watched)
        self._hook()

    # --- Drive, for the power machine ------------------------------------------------------------------------------

    def option(self, obj: Obj402) -> int:
        """Present value of an option code."""
        return self.dictionary.value(obj)

    def has_power(self) -> bool:
        """Supply there and no safe torque off."""
        return self.faults.supplied and not self.faults.inhibited

    def cause_gone(self) -> bool:
        """No cause of a fault is present, also none that counts only when switched on."""
        return self.faults.cause(self.joint.plant.temperature_c, switched_on=True) == 0

    def ignores(self, state: DriveState, transition: int) -> bool:
        """The vendor's objects make it disobey."""
        return self.faults.ignores(state, transition)

    def brake(self, ramp: Ramp, time_ns: int) -> None:
        """Begin to stop."""
        self.motion.stop(ramp, time_ns)

    def energise(self, time_ns: int) -> None:
        """Follow the targets."""
        self.dictionary.write_lock = True
        self.holding.torque(True, time_ns)
        self.motion.energise(time_ns)

    def cut(self, time_ns: int) -> None:
        """No torque."""
        self.dictionary.write_lock = False
        self.holding.torque(False, time_ns)
        self.motion.cut(time_ns)

    def fault_cleared(self, time_ns: int) -> None:
        """The fault was acknowledged: error code and EMCY go."""
        code, self._error = self._error, 0
        if code not in (Emcy.HEARTBEAT_LOST, Emcy.RPDO_TIME_OUT):  # these go when the master is heard again
            self.emergency.clear(code, time_ns)

    # --- Node ------------------------------------------------------------------------------------------------------

    def reset_application(self, time_ns: int) -> None:
        """Power on, or NMT reset node."""
        self._scale()
        self._error = 0
        self._too_far_since_ns = None
        self._mode_timer.cancel()
        self.motion.set_mode(Mode.NONE, time_ns)
        self.machine.start(time_ns)
        self.holding.output(self._outputs.value, self._outputs_mask.value, time_ns)
        self._mode_taken(time_ns)
        self._watch.arm(time_ns + _WATCH_NS)
        self._write_record(time_ns)

    def commanded(self, time_ns: int) -> None:
        """New control word or targets: judge the word with everything of its PDO in place."""
        self.holding.output(self._outputs.value, self._outputs_mask.value, time_ns)
        if self._mode_wanted.value != self.motion.mode and not self._mode_timer.armed:
            self._mode_timer.arm(time_ns + MODE_CHANGE_NS)
        if not self.faults.local:
            word = self._control.value
            self.motion.control(word, time_ns)
            self.machine.control(word, time_ns)
            self.motion.targets(time_ns)
        self._write_record(time_ns)

    def commands_overdue(self, time_ns: int) -> None:
        """As for a lost heartbeat: 0x6007, then 0x1029. A drive without power has nothing to react with."""
        if self.settings.command_deadline == "stops" and self._switched_on:
            self.connection_lost(time_ns, Emcy.RPDO_TIME_OUT)
            self._error_behaviour(time_ns)

    def connection_lost(self, time_ns: int, code: int = Emcy.HEARTBEAT_LOST) -> None:
        """Abort connection option code 0x6007."""
        option = self.dictionary.value(Obj402.ABORT_CONNECTION)
        if not self._switched_on:
            return
        if option == _ABORT_FAULT:
            self._fault(code, time_ns)
        elif option == _ABORT_DISABLE:
            self.machine.command(DriveCommand.DISABLE_VOLTAGE, time_ns)
        elif option == _ABORT_QUICK_STOP:
            self.machine.command(DriveCommand.QUICK_STOP, time_ns)
        self._write_record(time_ns)

    def refresh(self, time_ns: int) -> None:
        """Sample the sensor and bring all actual values up to date."""
        sensor, motion = self.sensor, self.motion
        sensor.sample(time_ns)
        self._supervise(time_ns)
        self._counts.value = wrap_i32(sensor.counts)
        self._position.value = position = wrap_i32(round(sensor.counts * sensor.user_per_count))
        user_per_rad = sensor.user_per_rad
        self._velocity.value = self._sensor_velocity.value = wrap_i32(round(sensor.velocity_rad_s * user_per_rad))
        self._torque.value = self._current.value = motion.produced
        self._demand.value = self._effort.value = min(max(round(motion.demand), -32768), 32767)
        if motion.mode is not Mode.CYCLIC_SYNC_TORQUE:
            self._refresh_demands(user_per_rad, position)
            self._watch_following_error(time_ns)
        self._digital_inputs.value = self.faults.inputs
        self._status.value = self._status_word()

    # --- inside ----------------------------------------------------------------------------------------------------

    def _at_rest(self, time_ns: int) -> None:
        """A stop came to rest: the brake that the drive sequences closes before the torque goes."""
        self.holding.close_then(self.machine.stopped, time_ns)

    @property
    def _switched_on(self) -> bool:
        return self.machine.state is DriveState.SWITCHED_ON or self.machine.state in ENERGISED

    def _refresh_demands(self, user_per_rad: float, position: int) -> None:
        """Position and velocity demands, which cyclic torque does not have."""
        self._position_demand.value = wrap_i32(round(self.motion.position_demand_rad * user_per_rad))
        self._internal_demand.value = self._position_demand.value
        self._velocity_demand.value = wrap_i32(round(self.motion.velocity_demand_rad_s * user_per_rad))
        controls = self.motion.mode in (Mode.CYCLIC_SYNC_POSITION, Mode.PROFILE_POSITION) and self.motion.following
        self._following.value = wrap_i32(self._position_demand.value - position) if controls else 0

    def _watch_following_error(self, time_ns: int) -> None:
        """Fault 8611 when 0x60F4 stays beyond 0x6065 for longer than 0x6066."""
        window = self.dictionary.value(Obj402.FOLLOWING_WINDOW)
        if window == _NO_FOLLOWING_WINDOW or abs(self._following.value) <= window:
            self._too_far_since_ns = None
        elif self._too_far_since_ns is None:
            self._too_far_since_ns = time_ns
        elif time_ns - self._too_far_since_ns > self.dictionary.value(Obj402.FOLLOWING_TIME_OUT) * 1_000_000:
            self._too_far_since_ns = None
            self._fault(Emcy.FOLLOWING_ERROR, time_ns)

    def _status_word(self) -> int:
        state, motion, faults = self.machine.state, self.motion, self.faults
        return status_word(
            state,
            supplied=faults.supplied,
            local=faults.local,
            warning=motion.limits.hot,
            limited=motion.limits.limited and state in ENERGISED,
            reached=motion.reached,
            follows=motion.follows,
            following_error=self._too_far_since_ns is not None,
        )

    def _supervise(self, time_ns: int) -> None:
        """Look for causes of faults."""
        state = self.machine.state
        code = self.faults.cause(self.joint.plant.temperature_c, self._switched_on)
        if code:
            self._fault(code, time_ns)
        elif state is DriveState.READY_TO_SWITCH_ON and not self.has_power():
            self.machine.command(DriveCommand.DISABLE_VOLTAGE, time_ns)

    def _fault(self, code: int, time_ns: int) -> None:
        if self._error == code:
            return
        self._error = self._error or code
        self.emergency.set(code, time_ns)
        self.machine.fault(time_ns, can_brake(code))
        self._write_record(time_ns)

    def _watched(self, time_ns: int) -> None:
        """The drive's own slow loop: supervision, record and event-driven TPDOs without any SYNC."""
        self._watch.arm(time_ns + _WATCH_NS)
        self.refresh(time_ns)
        self._write_record(time_ns)
        self._error_code.value = self._error
        present = (self._status.value, self._error, self._mode_shown.value)
        if present != self._announced:
            self._announced = present
            self.pdo.changed(self._events, time_ns)

    def _mode_taken(self, time_ns: int) -> None:
        """The mode asked for 3 ms ago acts and shows."""
        self.motion.set_mode(Mode(self._mode_wanted.value), time_ns)
        self._too_far_since_ns = None
        self._mode_shown.value = self.motion.mode

    def _write_record(self, time_ns: int) -> None:
        if self._record is None:
            return
        motion, plant = self.motion, self.joint.plant
        demand_nm, torque_nm = motion.demand * motion.nm_per_permille, self.joint.torque_nm
        words = (int(self.machine.state), self._status_word(), self._control.value, int(motion.mode))
        self._record.write((time_ns, *words, demand_nm, torque_nm, plant.position_rad, plant.velocity_rad_s))

    def _apply_settings(self) -> None:
        """What the settings say are the drive's defaults."""
        s, set_default = self.settings, self.dictionary.set_default
        set_default(Obj402.RATED_TORQUE, 0, s.rated_torque_mnm)
        set_default(Obj402.ENCODER_RESOLUTION, 1, s.amplifier_counts_per_turn)
        set_default(Obj402.FEED, 1, s.amplifier_counts_per_turn)
        set_default(Obj402.POLARITY, 0, s.polarity)
        set_default(0x2007, 0, int(s.command_deadline == "stops"))
        for obj in (Obj402.MAX_TORQUE, Obj402.MAX_CURRENT, Obj402.POSITIVE_TORQUE_LIMIT, Obj402.NEGATIVE_TORQUE_LIMIT):
            set_default(obj, 0, s.max_torque_permille)

    def _scale(self) -> None:
        self.sensor.scale()
        self.motion.scale()

    def _hook(self) -> None:
        """Let reads refresh and writes act."""
        entry = self.dictionary.entry
        self.dictionary.lock_while_enabled(LOCKED_WHILE_ENABLED)
        now = self._refresh_now
        for index in (0x2001, 0x603F, *range(0x6061, 0x6065), 0x6069, 0x606B, 0x606C, 0x6074, 0x6077, 0x6078, 0x6079):
            entry(index).read = now
        for index in (0x6041, 0x60F4, 0x60FA, 0x60FC, 0x60FD):
            entry(index).read = now
        for index in (0x6040, 0x6060, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60FF):
            entry(index).written = lambda value: self.commanded(self.timeline.now_ns)
        for subindex in (1, 2):
            entry(Obj402.DIGITAL_OUTPUTS, subindex).written = lambda value: self.commanded(self.timeline.now_ns)
        for index, subindex in ((0x6076, 0), (0x607E, 0), *((i, s) for i in (0x608F, 0x6091, 0x6092) for s in (1, 2))):
            entry(index, subindex).written = lambda value: self._scale()
        for subindex in (1, 2, 3):
            entry(0x2000, subindex).written = lambda value: self._supervise(self.timeline.now_ns)
        entry(Obj402.CONTROL_WORD).check = self._refuse_local
        entry(Obj402.MODE).check = self._check_mode
        for subindex in (1, 2):
            entry(0x607D, subindex).check = partial(self._check_limits, subindex)

    def _refresh_now(self) -> None:
        """Slow actual values that only SDO reads, then the rest."""
        self.refresh(self.timeline.now_ns)
        entry = self.dictionary.entry
        self._error_code.value = self._error
        entry(Obj402.DC_LINK_VOLTAGE).value = self.faults.supply_mv
        entry(0x2001).value = round(self.joint.plant.temperature_c * 10.0)

    def _refuse_local(self, value: int) -> None:
        if self.faults.local:
            raise SdoRefusal(Abort.LOCAL_CONTROL)

    def _check_mode(self, value: int) -> None:
        """Only the modes that 0x6502 names, and none at all."""
        if value and not self.dictionary.value(Obj402.SUPPORTED_MODES) >> (value - 1) & 1:
            raise SdoRefusal(Abort.VALUE_RANGE)

    def _check_limits(self, subindex: int, value: int) -> None:
        """Software position limits: the maximum may not lie below the minimum."""
        other = self.dictionary.value(0x607D, 3 - subindex)
        low, high = (value, other) if subindex == 1 else (other, value)
        if high < low:
            raise SdoRefusal(Abort.MAX_BELOW_MIN)
