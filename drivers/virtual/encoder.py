"""The virtual encoder: a CANopen node with the CiA 406 profile on the joint.

Sees what the plant's encoder sees (eccentricity and noise of the model included), counts it, scales it, wraps it at
any measuring range.
"""

from __future__ import annotations

import math
import random
from importlib.resources import files
from pathlib import Path

from servod.common.units import NS_PER_S, TWO_PI
from servod.drivers.virtual.dictionary import SdoRefusal
from servod.drivers.virtual.joint import Joint
from servod.drivers.virtual.node import Send, VirtualNode
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.cia import Abort, Emcy, Obj406

ENCODER_EDS = Path(str(files("servod.drivers") / "eds" / "encoder.eds"))
_CODE_SEQUENCE, _SCALING = 0x1, 0x4
_POSITION_ERROR, _SENSOR_ERROR = 0x1, 0x7300
#: Faster than this is not at rest: a preset is refused [rad/s].
_REST_RAD_S = 0.02
#: Speed 0x6030 in hundredths of a turn per minute, acceleration 0x6040 in hundredths of a turn per minute and ms.
_SPEED_UNITS_PER_RAD_S = 100.0 * 60.0 / TWO_PI
_SHORTEST_NS = 500_000
_TENTH_HOUR_NS = 360 * NS_PER_S


def _clip_i16(value: float) -> int:
    return min(max(round(value), -32768), 32767)


class EncoderNode(VirtualNode):
    """The node."""

    def __init__(self, settings: VirtualAxisSettings, joint: Joint, timeline: Timeline, send: Send) -> None:
        super().__init__(ENCODER_EDS, settings.encoder_node_id, settings.encoder_serial, timeline, send)
        self.settings, self.joint = settings, joint
        self._random = random.Random(settings.seed + 1)  # noqa: S311  (noise, not secrets)
        entry = self.dictionary.entry
        self._position, self._wide, self._channel = entry(Obj406.POSITION), entry(0x6008), entry(0x6020, 1)
        self._speed, self._acceleration = entry(Obj406.SPEED, 1), entry(0x6040, 1)
        self._alarms, self._warnings, self._offset = entry(Obj406.ALARMS), entry(Obj406.WARNINGS), entry(Obj406.OFFSET)
        self._frozen, self._jump, self._noise = (entry(0x2000, subindex) for subindex in (3, 4, 5))
        self._range, self._cam = entry(Obj406.MEASURING_RANGE), entry(0x6300, 1)
        self._counts_per_rad = settings.encoder_direction * settings.encoder_counts_per_turn / TWO_PI
        self._scale = 1.0
        self._read_ns = -1
        self._units = 0  # scaled, before offset and wrap
        self._speed_ns = -1
        self._speed_rad = self._speed_rad_s = 0.0
        self._started_ns = 0
        self._apply_settings()
        self._hook()

    def reset_application(self, time_ns: int) -> None:
        """Power on, or NMT reset node."""
        self._started_ns, self._read_ns, self._speed_ns = time_ns, -1, -1
        self._rescale()

    def commanded(self, time_ns: int) -> None:
        """An encoder has no RPDO: nothing to judge."""

    def connection_lost(self, time_ns: int, code: int = Emcy.HEARTBEAT_LOST) -> None:
        """An encoder moves nothing: it goes on measuring."""

    def refresh(self, time_ns: int) -> None:
        """Read the joint at `time_ns`; a second read at the same moment gives the same value."""
        if time_ns == self._read_ns or self._frozen.value:
            return
        self._read_ns = time_ns
        joint = self.joint
        joint.advance(time_ns)
        angle = joint.plant.encoder_position_rad
        counts = angle * self._counts_per_rad
        noise = self.settings.encoder_noise_counts + self._noise.value
        if noise:
            counts += self._random.gauss(0.0, noise)
        counts += self._jump.value
        self._units = math.floor(math.floor(counts + 0.5) * self._scale)
        self._position.value = (self._units + self._offset.value) % self._range.value
        self._refresh_speed(angle, time_ns)

    def _refresh_speed(self, angle: float, time_ns: int) -> None:
        span_ns = time_ns - self._speed_ns
        if self._speed_ns < 0:
            self._speed_ns, self._speed_rad = time_ns, angle
        elif span_ns >= _SHORTEST_NS:
            speed = (angle - self._speed_rad) * NS_PER_S / span_ns
            change = (speed - self._speed_rad_s) * _SPEED_UNITS_PER_RAD_S
            self._acceleration.value = _clip_i16(change * 1e6 / span_ns)
            self._speed.value = _clip_i16(speed * _SPEED_UNITS_PER_RAD_S)
            self._speed_ns, self._speed_rad, self._speed_rad_s = time_ns, angle, speed

    def _refresh_slow(self) -> None:
        """Everything that only SDO and event PDOs read."""
        now_ns = self.timeline.now_ns
        self.refresh(now_ns)
        position = self._position.value
        self._wide.value = position
        self._channel.value = (position + 0x80000000 & 0xFFFFFFFF) - 0x80000000
        self.dictionary.entry(0x6508).value = (now_ns - self._started_ns) // _TENTH_HOUR_NS
        value = self.dictionary.value
        inside = value(0x6310, 1) <= position <= value(0x6320, 1)
        self._cam.value = int(inside is not bool(value(0x6302, 1))) if value(0x6301, 1) else 0

    def _apply_settings(self) -> None:
        """What the settings say are the encoder's defaults."""
        s, set_default = self.settings, self.dictionary.set_default
        set_default(Obj406.UNITS_PER_TURN, 0, s.encoder_counts_per_turn)
        set_default(Obj406.SINGLE_TURN_RESOLUTION, 0, s.encoder_counts_per_turn)
        set_default(Obj406.MEASURING_RANGE, 0, s.encoder_measuring_range_counts)
        turns = max(1, s.encoder_measuring_range_counts // s.encoder_counts_per_turn)
        set_default(Obj406.TURNS, 0, min(turns, 0xFFFF))
        set_default(0x650B, 0, s.encoder_serial)

    def _rescale(self) -> None:
        """Take over operating parameters, resolution and range."""
        value = self.dictionary.value
        operating = value(Obj406.OPERATING_PARAMETERS)
        self.dictionary.entry(Obj406.OPERATING_STATUS).value = operating
        scaled = value(Obj406.UNITS_PER_TURN) / self.settings.encoder_counts_per_turn
        self._scale = (scaled if operating & _SCALING else 1.0) * (-1.0 if operating & _CODE_SEQUENCE else 1.0)
        self._read_ns = -1

    def _preset(self, value: int) -> None:
        """The position shall read `value` here and now (0x6003); only at rest."""
        self._read_ns = -1
        self.refresh(self.timeline.now_ns)
        offset = (value - self._units) % self._range.value
        self._offset.value = offset - self._range.value if offset > 0x7FFFFFFF else offset
        self._read_ns = -1

    def _check_preset(self, value: int) -> None:
        if abs(self.joint.plant.velocity_rad_s) > _REST_RAD_S:
            raise SdoRefusal(Abort.PRESENT_STATE)
        if value >= self._range.value:
            raise SdoRefusal(Abort.VALUE_TOO_HIGH)

    def _check_channel_preset(self, value: int) -> None:
        if value < 0:
            raise SdoRefusal(Abort.VALUE_TOO_LOW)
        self._check_preset(value)

    def _set_alarms(self, alarms: int) -> None:
        self._alarms.value = alarms
        now_ns = self.timeline.now_ns
        if alarms & _POSITION_ERROR:
            self.emergency.set(_SENSOR_ERROR, now_ns)
        else:
            self.emergency.clear(_SENSOR_ERROR, now_ns)
        self.pdo.changed((self._alarms,), now_ns)

    def _set_warnings(self, warnings: int) -> None:
        self._warnings.value = warnings
        self.pdo.changed((self._warnings,), self.timeline.now_ns)

    def _cyclic_timer(self, time_ms: int) -> None:
        """0x6200 and the event timer of TPDO1 are one value (CiA 406)."""
        self.dictionary.entry(0x1800, 5).value = self.dictionary.entry(Obj406.CYCLIC_TIMER).value = time_ms
        self.pdo.tpdos[0].configure()

    def _hook(self) -> None:
        """Let reads refresh and writes act."""
        entry = self.dictionary.entry
        for index, sub in ((0x6004, 0), (0x6008, 0), (0x6020, 1), (0x6030, 1), (0x6040, 1), (0x6300, 1), (0x6508, 0)):
            entry(index, sub).read = self._refresh_slow
        for index in (0x6000, 0x6001, 0x6002):
            entry(index).written = lambda value: self._rescale()
        entry(Obj406.PRESET).check, entry(Obj406.PRESET).written = self._check_preset, self._preset
        entry(0x6010, 1).check, entry(0x6010, 1).written = self._check_channel_preset, self._preset
        entry(0x2000, 1).written, entry(0x2000, 2).written = self._set_alarms, self._set_warnings
        entry(Obj406.CYCLIC_TIMER).written = entry(0x1800, 5).written = self._cyclic_timer
