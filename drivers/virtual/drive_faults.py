"""What makes the amplifier fault by itself, and whether the cause is gone: supply, STO, temperature, on demand.

Beside the power machine. The objects 0x2000 are the vendor's: they put causes into the drive for trying.
"""

from __future__ import annotations

from servod.drivers.virtual.dictionary import Dictionary
from servod.runtime.fieldbus.devices import DriveState

UNDER_VOLTAGE, OVER_VOLTAGE, SAFE_TORQUE_OFF, MOTOR_TEMPERATURE = 0x3220, 0x3210, 0x5441, 0x4310
_LOWEST_MV, _HIGHEST_MV = 18_000, 60_000
_MOTOR_LIMIT_C = 120.0
#: Error classes (high nibble of the code) after which the power stage cannot brake any more.
_UNUSABLE = (0x2, 0x3, 0x5)


class DriveFaults:
    """Reads the causes; `0x2000` sub 1 error code, 2 safe torque off, 3 supply in mV, 4 local control, 5 the state
    (servod.runtime.fieldbus.devices.DriveState) in which control words do nothing, 6 the transition that control
    words do not cause."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._injected = dictionary.entry(0x2000, 1)
        self._safe_torque_off = dictionary.entry(0x2000, 2)
        self._supply_mv = dictionary.entry(0x2000, 3)
        self._local = dictionary.entry(0x2000, 4)
        self._stuck = dictionary.entry(0x2000, 5)
        self._refused = dictionary.entry(0x2000, 6)

    @property
    def supplied(self) -> bool:
        """True when the DC link has its voltage (status word bit 4)."""
        return self._supply_mv.value >= _LOWEST_MV

    @property
    def inhibited(self) -> bool:
        """True while safe torque off is active."""
        return bool(self._safe_torque_off.value)

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
