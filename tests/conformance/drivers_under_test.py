"""Builds every known driver from its own set-up face, and the frames that its plan maps. Knows no driver by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from servod.formats.config import AxisConfig
from servod.runtime.fieldbus.cia import EMCY_BASE, Obj402, Obj406
from servod.runtime.fieldbus.devices import Amplifier, AmplifierCommand, DriveState, Encoder, Goal, NodePlan, PdoMap
from servod.runtime.fieldbus.registry import driver_table, load_driver

PERIOD_NS = 1_000_000
MEASURING_RANGE = 3_000_001  # not a power of two, not a multiple of a turn
COUNTS_PER_TURN = 1_000_000
RATED_TORQUE_MNM = 2_000
LIMITS = {
    "torque_nm": 1.0,
    "torque_rate_nm_per_s": 100.0,
    "speed_rad_s": 10.0,
    "position_min_rad": -1.0,
    "position_max_rad": 1.0,
    "following_error_rad": 0.5,
    "encoder_mismatch_rad": 0.2,
}

#: A status word of each state, with voltage and remote shown.
STATUS_WORD = {
    DriveState.NOT_READY_TO_SWITCH_ON: 0x0210,
    DriveState.SWITCH_ON_DISABLED: 0x0250,
    DriveState.READY_TO_SWITCH_ON: 0x0231,
    DriveState.SWITCHED_ON: 0x0233,
    DriveState.OPERATION_ENABLED: 0x0237,
    DriveState.QUICK_STOP_ACTIVE: 0x0217,
    DriveState.FAULT_REACTION_ACTIVE: 0x021F,
    DriveState.FAULT: 0x0218,
    DriveState.UNKNOWN: 0x0263,
}


def names_of(kind: str) -> list[str]:
    """All drivers of a kind, the installed entry points among them."""
    return sorted(name for name in driver_table() if load_driver(name).kind == kind)


def axis_config(**sections: Any) -> AxisConfig:
    """A configuration that states everything a device would otherwise be asked for."""
    amplifier = {"rated_torque_mnm": RATED_TORQUE_MNM, "counts_per_turn": COUNTS_PER_TURN}
    encoder = {
        "counts_per_turn": COUNTS_PER_TURN,
        "measuring_range_counts": MEASURING_RANGE,
        "velocity_cutoff_hz": 100.0,
    }
    return AxisConfig.model_validate(
        {
            "limits": LIMITS,
            "gains": {"initial": "gains.yaml"},
            "amplifier": amplifier | sections.pop("amplifier", {}),
            "encoder": encoder | sections.pop("encoder", {}),
        }
        | sections
    )


def plan_of(kind: str, name: str, **options: Any) -> NodePlan:
    """The plan of a driver, made without a bus."""
    config = axis_config(**{kind: {"driver": name} | options})
    plan: NodePlan = load_driver(name).setup(config).plan()
    return plan


def find_pdo(plan: NodePlan, index: int) -> PdoMap:
    """The planned PDO that maps an object."""
    return next(pdo for pdo in plan.pdos if index in {entry.index for entry in pdo.entries})


def by_events_alone(pdo: PdoMap) -> PdoMap:
    """The same PDO without a time after which it must come again; one that comes with each SYNC as it is."""
    return pdo if pdo.receive or pdo.syncs == 1 else replace(pdo, transmission_type=255, event_timer_ms=0)


def encode(pdo: PdoMap, values: dict[int, int]) -> bytes:
    """Data of a PDO with these objects, all others zero; two's complement in the mapped length."""
    word, shift = 0, 0
    for entry in pdo.entries:
        word |= (values.get(entry.index, 0) & (1 << entry.bits) - 1) << shift
        shift += entry.bits
    return word.to_bytes(pdo.data_bytes, "little")


def decode(pdo: PdoMap, data: bytes, index: int) -> int:
    """One object of a PDO's data, signed."""
    word, shift = int.from_bytes(data, "little"), 0
    for entry in pdo.entries:
        if entry.index == index:
            value = word >> shift & (1 << entry.bits) - 1
            return value - (1 << entry.bits) if value >> (entry.bits - 1) else value
        shift += entry.bits
    raise AssertionError(f"0x{index:04X} is not mapped")


class AmplifierBench:
    """One amplifier driver and its wire: what the drive says goes in, what the driver sends comes out."""

    def __init__(self, name: str, **options: Any) -> None:
        self.plan = plan_of("amplifier", name, **options)
        self.driver: Amplifier = load_driver(name).cyclic(self.plan)
        self.feedback_pdo = find_pdo(self.plan, Obj402.STATUS_WORD)
        self.command_pdo = find_pdo(self.plan, Obj402.CONTROL_WORD)
        self.slow_pdo = find_pdo(self.plan, Obj402.MODE_DISPLAY)
        self.time_ns = 0

    def say(self, state: DriveState, position: int = 0, torque: int = 0, flags: int = 0) -> bool:
        """One synchronous feedback frame of the drive."""
        self.time_ns += PERIOD_NS
        values = {
            Obj402.STATUS_WORD: STATUS_WORD[state] | flags,
            Obj402.POSITION_ACTUAL: position,
            Obj402.TORQUE_ACTUAL: torque,
        }
        return self.driver.on_frame(self.feedback_pdo.cob_id, encode(self.feedback_pdo, values), self.time_ns)

    def say_mode(self, mode: int, error_code: int = 0) -> bool:
        """The drive's slow PDO."""
        values = {Obj402.MODE_DISPLAY: mode, Obj402.ERROR_CODE: error_code}
        return self.driver.on_frame(self.slow_pdo.cob_id, encode(self.slow_pdo, values), self.time_ns)

    def say_emcy(self, code: int) -> bool:
        """An emergency message."""
        data = code.to_bytes(2, "little") + bytes(6)
        return self.driver.on_frame(EMCY_BASE + self.plan.node_id, data, self.time_ns)

    def ask(self, goal: Goal, torque_nm: float = 0.0, **flags: Any) -> tuple[int, int]:
        """One command: (control word, torque in per mille) as they go to the wire."""
        can_id, data = self.driver.write(AmplifierCommand(goal, torque_nm, **flags))
        assert can_id == self.command_pdo.cob_id
        assert len(data) == self.command_pdo.data_bytes
        word = decode(self.command_pdo, data, Obj402.CONTROL_WORD) & 0xFFFF
        return word, decode(self.command_pdo, data, Obj402.TARGET_TORQUE)

    def cycle(self, state: DriveState, goal: Goal, torque_nm: float = 0.0, **flags: Any) -> tuple[int, int]:
        """One whole cycle: feedback, read, write."""
        self.say(state)
        self.driver.read()
        return self.ask(goal, torque_nm, **flags)


class EncoderBench:
    """One encoder driver and its wire."""

    def __init__(self, name: str, **options: Any) -> None:
        self.plan = plan_of("encoder", name, **options)
        self.driver: Encoder = load_driver(name).cyclic(self.plan)
        self.position_pdo = find_pdo(self.plan, Obj406.POSITION)
        self.alarm_pdo = find_pdo(self.plan, Obj406.ALARMS)
        self.range = int(self.plan.facts["measuring_range_counts"])

    def say(self, counts: int, time_ns: int) -> bool:
        """One position frame; `counts` wraps at the measuring range as the device does."""
        data = encode(self.position_pdo, {Obj406.POSITION: counts % self.range})
        return self.driver.on_frame(self.position_pdo.cob_id, data, time_ns)

    def say_alarms(self, alarms: int) -> bool:
        """The device's alarm PDO."""
        return self.driver.on_frame(self.alarm_pdo.cob_id, encode(self.alarm_pdo, {Obj406.ALARMS: alarms}), 0)
