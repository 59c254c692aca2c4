"""Tables of CiA 301, 402 and 406 that master, drivers and virtual nodes share: numbers, names, nothing that acts.

Stands on servod.runtime.fieldbus.devices for the state names. Sources: CiA 301 v4.2, CiA 402-2, CiA 406 as quoted in
vendors' manuals.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum

from servod.runtime.fieldbus.devices import DriveState

# --- CiA 301: predefined connection set ---------------------------------------------------------------------------
NMT_ID, SYNC_ID, EMCY_BASE, TIME_ID = 0x000, 0x080, 0x080, 0x100
TPDO_BASE = (0x180, 0x280, 0x380, 0x480)
RPDO_BASE = (0x200, 0x300, 0x400, 0x500)
SDO_ANSWER_BASE, SDO_REQUEST_BASE, HEARTBEAT_BASE = 0x580, 0x600, 0x700
LSS_TO_SLAVE_ID, LSS_FROM_SLAVE_ID = 0x7E5, 0x7E4


def ids_of_masters(node_ids: Iterable[int], master_node_id: int) -> set[int]:
    """Identifiers of what only a master sends: its own, NMT, SYNC, TIME, LSS, and command PDOs to these nodes.

    An LSS answer, too: no slave sends one that no master asked for (CiA 305), and we ask none.
    """
    commands = {base + node_id for base in RPDO_BASE for node_id in node_ids}
    own = {EMCY_BASE + master_node_id, HEARTBEAT_BASE + master_node_id}
    return commands | own | {NMT_ID, SYNC_ID, TIME_ID, LSS_TO_SLAVE_ID, LSS_FROM_SLAVE_ID}


PDO_NOT_VALID = 0x80000000
PDO_NO_RTR = 0x40000000


class NmtCommand(IntEnum):
    """First byte of an NMT frame."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class NmtState(IntEnum):
    """Heartbeat byte."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Abort(IntEnum):
    """SDO abort codes (CiA 301, 7.2.4.3.17)."""

    TOGGLE_BIT = 0x05030000
    TIME_OUT = 0x05040000
    BAD_COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE_NUMBER = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    ACCESS = 0x06010000
    READ_OF_WRITE_ONLY = 0x06010001
    WRITE_OF_READ_ONLY = 0x06010002
    NO_SUCH_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_TOO_LONG = 0x06040042
    INCOMPATIBLE_PARAMETER = 0x06040043
    INTERNAL_INCOMPATIBLE = 0x06040047
    HARDWARE = 0x06060000
    LENGTH_MISMATCH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUCH_SUBINDEX = 0x06090011
    VALUE_RANGE = 0x06090030
    VALUE_TOO_HIGH = 0x06090031
    VALUE_TOO_LOW = 0x06090032
    MAX_BELOW_MIN = 0x06090036
    RESOURCE = 0x060A0023
    GENERAL = 0x08000000
    CANNOT_STORE = 0x08000020
    LOCAL_CONTROL = 0x08000021
    PRESENT_STATE = 0x08000022
    NO_DICTIONARY = 0x08000023
    NO_DATA = 0x08000024


class Emcy(IntEnum):
    """Emergency error codes that servod names."""

    NONE = 0x0000
    ERROR_PASSIVE = 0x8120
    HEARTBEAT_LOST = 0x8130
    BUS_OFF_RECOVERED = 0x8140
    PDO_LENGTH = 0x8210
    PDO_TOO_LONG = 0x8220
    SYNC_LENGTH = 0x8240
    RPDO_TIME_OUT = 0x8250
    FOLLOWING_ERROR = 0x8611


class Obj301(IntEnum):
    """Communication objects of CiA 301."""

    DEVICE_TYPE = 0x1000
    ERROR_REGISTER = 0x1001
    ERROR_HISTORY = 0x1003
    SYNC_COB_ID = 0x1005
    CYCLE_PERIOD = 0x1006
    SYNC_WINDOW = 0x1007
    DEVICE_NAME = 0x1008
    HARDWARE_VERSION = 0x1009
    SOFTWARE_VERSION = 0x100A
    STORE = 0x1010
    RESTORE = 0x1011
    EMCY_COB_ID = 0x1014
    EMCY_INHIBIT = 0x1015
    HEARTBEAT_CONSUMER = 0x1016
    HEARTBEAT_PRODUCER = 0x1017
    IDENTITY = 0x1018
    SYNC_OVERFLOW = 0x1019
    ERROR_BEHAVIOUR = 0x1029
    RPDO_PARAMETER = 0x1400
    RPDO_MAPPING = 0x1600
    TPDO_PARAMETER = 0x1800
    TPDO_MAPPING = 0x1A00


class Obj402(IntEnum):
    """Objects of CiA 402."""

    ABORT_CONNECTION = 0x6007
    ERROR_CODE = 0x603F
    CONTROL_WORD = 0x6040
    STATUS_WORD = 0x6041
    QUICK_STOP_OPTION = 0x605A
    SHUTDOWN_OPTION = 0x605B
    DISABLE_OPTION = 0x605C
    HALT_OPTION = 0x605D
    FAULT_REACTION_OPTION = 0x605E
    MODE = 0x6060
    MODE_DISPLAY = 0x6061
    POSITION_ACTUAL = 0x6064
    FOLLOWING_WINDOW = 0x6065
    FOLLOWING_TIME_OUT = 0x6066
    VELOCITY_ACTUAL = 0x606C
    VELOCITY_THRESHOLD = 0x606F
    VELOCITY_THRESHOLD_TIME = 0x6070
    TARGET_TORQUE = 0x6071
    MAX_TORQUE = 0x6072
    MAX_CURRENT = 0x6073
    TORQUE_DEMAND = 0x6074
    RATED_CURRENT = 0x6075
    RATED_TORQUE = 0x6076
    TORQUE_ACTUAL = 0x6077
    CURRENT_ACTUAL = 0x6078
    DC_LINK_VOLTAGE = 0x6079
    TARGET_POSITION = 0x607A
    POSITION_LIMITS = 0x607D
    POLARITY = 0x607E
    MAX_PROFILE_VELOCITY = 0x607F
    MAX_MOTOR_SPEED = 0x6080
    PROFILE_DECELERATION = 0x6084
    QUICK_STOP_DECELERATION = 0x6085
    TORQUE_SLOPE = 0x6087
    ENCODER_RESOLUTION = 0x608F
    GEAR_RATIO = 0x6091
    FEED = 0x6092
    VELOCITY_UNIT = 0x60A9
    TORQUE_OFFSET = 0x60B2
    INTERPOLATION_PERIOD = 0x60C2
    POSITIVE_TORQUE_LIMIT = 0x60E0
    NEGATIVE_TORQUE_LIMIT = 0x60E1
    FOLLOWING_ERROR_ACTUAL = 0x60F4
    DIGITAL_INPUTS = 0x60FD
    DIGITAL_OUTPUTS = 0x60FE
    TARGET_VELOCITY = 0x60FF
    SUPPORTED_MODES = 0x6502


class Obj406(IntEnum):
    """Objects of CiA 406."""

    OPERATING_PARAMETERS = 0x6000
    UNITS_PER_TURN = 0x6001
    MEASURING_RANGE = 0x6002
    PRESET = 0x6003
    POSITION = 0x6004
    SPEED = 0x6030
    CYCLIC_TIMER = 0x6200
    OPERATING_STATUS = 0x6500
    SINGLE_TURN_RESOLUTION = 0x6501
    TURNS = 0x6502
    ALARMS = 0x6503
    SUPPORTED_ALARMS = 0x6504
    WARNINGS = 0x6505
    OFFSET = 0x6509


#: Objects of CiA 402 and 406 that act when they are written: commands, modes, set-points, outputs and presets. In a
#: file they are what a tool saw at one moment, not parameters; see `acts_when_written`.
ACTING_OBJECTS = frozenset(
    {
        Obj402.CONTROL_WORD,
        Obj402.MODE,
        Obj402.TARGET_TORQUE,
        Obj402.TARGET_POSITION,
        Obj402.TARGET_VELOCITY,
        Obj402.TORQUE_OFFSET,
        0x6042,  # vl target velocity
        0x60B0,  # position offset
        0x60B1,  # velocity offset
        0x60B8,  # touch probe function
        0x60C1,  # interpolation data record
        Obj402.DIGITAL_OUTPUTS,  # the brake among them
        Obj406.PRESET,
        0x6010,  # preset values of an encoder with several channels
    }
)
_FIRST_PROFILE_OBJECT, _LAST_PROFILE_OBJECT, _LOGICAL_DEVICE = 0x6000, 0x9FFF, 0x800


def acts_when_written(index: int) -> bool:
    """Whether an object is in ACTING_OBJECTS, on any of the eight logical devices of a node (CiA 301: 0x800 apart)."""
    if not _FIRST_PROFILE_OBJECT <= index <= _LAST_PROFILE_OBJECT:
        return False
    return _FIRST_PROFILE_OBJECT + index % _LOGICAL_DEVICE in ACTING_OBJECTS


# --- CiA 402: status word ------------------------------------------------------------------------------------------
#: (mask, value, state); a word that matches none of the rows is UNKNOWN.
STATUS_WORD_TABLE: tuple[tuple[int, int, DriveState], ...] = (
    (0x4F, 0x00, DriveState.NOT_READY_TO_SWITCH_ON),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY_TO_SWITCH_ON),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, DriveState.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, DriveState.FAULT),
)


def decode_status_word(status_word: int) -> DriveState:
    """State of a status word by the table of CiA 402; a word that matches no row is UNKNOWN, never a guess."""
    for mask, value, state in STATUS_WORD_TABLE:
        if status_word & mask == value:
            return state
    return DriveState.UNKNOWN


SW_VOLTAGE_ENABLED = 1 << 4
SW_QUICK_STOP = 1 << 5  # active low
SW_WARNING = 1 << 7
SW_REMOTE = 1 << 9
SW_TARGET_REACHED = 1 << 10
SW_INTERNAL_LIMIT = 1 << 11
SW_FOLLOWS_COMMAND = 1 << 12

CW_SHUTDOWN = 0x0006
CW_SWITCH_ON = 0x0007
CW_ENABLE_OPERATION = 0x000F
CW_DISABLE_VOLTAGE = 0x0000
CW_QUICK_STOP = 0x0002
CW_FAULT_RESET = 0x0080
CW_HALT = 0x0100
