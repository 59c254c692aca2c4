"""The numbers of CiA 301, 402 and 406, written down a second time from the standards' tables."""

from __future__ import annotations

from enum import IntEnum

import pytest

from servod.runtime.fieldbus import cia
from servod.runtime.fieldbus.cia import Abort, Emcy, NmtCommand, NmtState, Obj301, Obj402, Obj406, acts_when_written

PRINTED: list[tuple[type[IntEnum], str]] = [
    (NmtCommand, "START 1 STOP 2 PRE_OPERATIONAL 80 RESET_NODE 81 RESET_COMMUNICATION 82"),
    (NmtState, "BOOT_UP 0 STOPPED 4 OPERATIONAL 5 PRE_OPERATIONAL 7F"),
    (
        Abort,
        "TOGGLE_BIT 05030000 TIME_OUT 05040000 BAD_COMMAND 05040001 BLOCK_SIZE 05040002 SEQUENCE_NUMBER 05040003 "
        "CRC 05040004 OUT_OF_MEMORY 05040005 ACCESS 06010000 READ_OF_WRITE_ONLY 06010001 WRITE_OF_READ_ONLY 06010002 "
        "NO_SUCH_OBJECT 06020000 NOT_MAPPABLE 06040041 PDO_TOO_LONG 06040042 INCOMPATIBLE_PARAMETER 06040043 "
        "INTERNAL_INCOMPATIBLE 06040047 HARDWARE 06060000 LENGTH_MISMATCH 06070010 TOO_LONG 06070012 "
        "TOO_SHORT 06070013 NO_SUCH_SUBINDEX 06090011 VALUE_RANGE 06090030 VALUE_TOO_HIGH 06090031 "
        "VALUE_TOO_LOW 06090032 MAX_BELOW_MIN 06090036 RESOURCE 060A0023 GENERAL 08000000 CANNOT_STORE 08000020 "
        "LOCAL_CONTROL 08000021 PRESENT_STATE 08000022 NO_DICTIONARY 08000023 NO_DATA 08000024",
    ),
    (
        Emcy,
        "NONE 0 ERROR_PASSIVE 8120 HEARTBEAT_LOST 8130 BUS_OFF_RECOVERED 8140 PDO_LENGTH 8210 PDO_TOO_LONG 8220 "
        "SYNC_LENGTH 8240 RPDO_TIME_OUT 8250 FOLLOWING_ERROR 8611",
    ),
    (
        Obj301,
        "DEVICE_TYPE 1000 ERROR_REGISTER 1001 ERROR_HISTORY 1003 SYNC_COB_ID 1005 CYCLE_PERIOD 1006 SYNC_WINDOW 1007 "
        "DEVICE_NAME 1008 HARDWARE_VERSION 1009 SOFTWARE_VERSION 100A STORE 1010 RESTORE 1011 EMCY_COB_ID 1014 "
        "EMCY_INHIBIT 1015 HEARTBEAT_CONSUMER 1016 HEARTBEAT_PRODUCER 1017 IDENTITY 1018 SYNC_OVERFLOW 1019 "
        "ERROR_BEHAVIOUR 1029 RPDO_PARAMETER 1400 RPDO_MAPPING 1600 TPDO_PARAMETER 1800 TPDO_MAPPING 1A00",
    ),
    (
        Obj402,
        "ABORT_CONNECTION 6007 ERROR_CODE 603F CONTROL_WORD 6040 STATUS_WORD 6041 QUICK_STOP_OPTION 605A "
        "SHUTDOWN_OPTION 605B DISABLE_OPTION 605C HALT_OPTION 605D FAULT_REACTION_OPTION 605E MODE 6060 "
        "MODE_DISPLAY 6061 POSITION_ACTUAL 6064 FOLLOWING_WINDOW 6065 FOLLOWING_TIME_OUT 6066 "
        "VELOCITY_ACTUAL 606C VELOCITY_THRESHOLD 606F VELOCITY_THRESHOLD_TIME 6070 TARGET_TORQUE 6071 "
        "MAX_TORQUE 6072 MAX_CURRENT 6073 TORQUE_DEMAND 6074 RATED_CURRENT 6075 RATED_TORQUE 6076 "
        "TORQUE_ACTUAL 6077 CURRENT_ACTUAL 6078 DC_LINK_VOLTAGE 6079 TARGET_POSITION 607A POSITION_LIMITS 607D "
        "POLARITY 607E MAX_PROFILE_VELOCITY 607F MAX_MOTOR_SPEED 6080 PROFILE_DECELERATION 6084 "
        "QUICK_STOP_DECELERATION 6085 TORQUE_SLOPE 6087 ENCODER_RESOLUTION 608F GEAR_RATIO 6091 FEED 6092 "
        "VELOCITY_UNIT 60A9 TORQUE_OFFSET 60B2 INTERPOLATION_PERIOD 60C2 POSITIVE_TORQUE_LIMIT 60E0 "
        "NEGATIVE_TORQUE_LIMIT 60E1 FOLLOWING_ERROR_ACTUAL 60F4 DIGITAL_INPUTS 60FD DIGITAL_OUTPUTS 60FE "
        "TARGET_VELOCITY 60FF SUPPORTED_MODES 6502",
    ),
    (
        Obj406,
        "OPERATING_PARAMETERS 6000 UNITS_PER_TURN 6001 MEASURING_RANGE 6002 PRESET 6003 POSITION 6004 SPEED 6030 "
        "CYCLIC_TIMER 6200 OPERATING_STATUS 6500 SINGLE_TURN_RESOLUTION 6501 TURNS 6502 ALARMS 6503 "
        "SUPPORTED_ALARMS 6504 WARNINGS 6505 OFFSET 6509",
    ),
]


@pytest.mark.parametrize(("table", "text"), PRINTED, ids=lambda value: getattr(value, "__name__", ""))
def test_every_number_is_the_printed_one(table: type[IntEnum], text: str) -> None:
    words = text.split()
    printed = dict(zip(words[::2], (int(word, 16) for word in words[1::2]), strict=True))
    assert printed == {member.name: int(member) for member in table}


def test_identifiers_of_the_predefined_connection_set() -> None:
    assert (cia.NMT_ID, cia.SYNC_ID, cia.EMCY_BASE, cia.TIME_ID) == (0, 0x80, 0x80, 0x100)
    assert cia.TPDO_BASE == (0x180, 0x280, 0x380, 0x480)
    assert cia.RPDO_BASE == (0x200, 0x300, 0x400, 0x500)
    assert (cia.SDO_ANSWER_BASE, cia.SDO_REQUEST_BASE, cia.HEARTBEAT_BASE) == (0x580, 0x600, 0x700)
    assert (cia.LSS_TO_SLAVE_ID, cia.LSS_FROM_SLAVE_ID) == (0x7E5, 0x7E4)
    assert (cia.PDO_NOT_VALID, cia.PDO_NO_RTR) == (1 << 31, 1 << 30)


def test_bits_of_status_word_and_control_words() -> None:
    bits = (cia.SW_VOLTAGE_ENABLED, cia.SW_QUICK_STOP, cia.SW_WARNING, cia.SW_REMOTE, cia.SW_TARGET_REACHED)
    assert bits == (0x10, 0x20, 0x80, 0x200, 0x400)
    assert (cia.SW_INTERNAL_LIMIT, cia.SW_FOLLOWS_COMMAND) == (0x800, 0x1000)
    assert (cia.CW_SHUTDOWN, cia.CW_SWITCH_ON, cia.CW_ENABLE_OPERATION, cia.CW_DISABLE_VOLTAGE) == (6, 7, 15, 0)
    assert (cia.CW_QUICK_STOP, cia.CW_FAULT_RESET, cia.CW_HALT) == (2, 0x80, 0x100)


#: Objects that act when they are written.
ACTING = {
    0x6003,
    0x6010,
    0x6040,
    0x6042,
    0x6060,
    0x6071,
    0x607A,
    0x60B0,
    0x60B1,
    0x60B2,
    0x60B8,
    0x60C1,
    0x60FE,
    0x60FF,
}


def test_objects_that_act_do_so_on_all_eight_logical_devices_and_nowhere_else() -> None:
    acting = {index for index in range(0x10000) if acts_when_written(index)}
    assert acting == {index + 0x800 * device for index in ACTING for device in range(8)}


def test_every_row_of_the_status_word_leaves_no_word_to_two_states() -> None:
    rows = cia.STATUS_WORD_TABLE
    assert [(mask, value) for mask, value, _ in rows] == [
        (0x4F, 0x00), (0x4F, 0x40), (0x6F, 0x21), (0x6F, 0x23), (0x6F, 0x27), (0x6F, 0x07), (0x4F, 0x0F), (0x4F, 0x08),
    ]  # fmt: skip
    assert [int(state) for _, _, state in rows] == [1, 2, 3, 4, 5, 6, 7, 8]
