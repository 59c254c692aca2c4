"""Where real drives differ from CiA 402, as data: one row per maker, each deviation with its source and our answer.

The set-up face (drivers/cia402_setup.py) and the master's bring-up act on the fields; `deviations` says for people
what was found, where, and what servod does about it. `amplifier.quirks` in the configuration names the row; "none" is
the standard itself. Deviations that servod's normal way already covers are listed too, so that nobody undoes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from servod.common.errors import BadInput
from servod.runtime.fieldbus.cia import Emcy


class Presence(IntEnum):
    """Whether an object must exist in a drive."""

    OPTIONAL = 1  # written when it exists, noted when not
    REQUIRED = 2  # the drive does not work in the cyclic modes without it: its absence ends the bring-up


class CommandDeadline(IntEnum):
    """What a drive does when its command frames stay away for longer than 0x1400:5; CiA 301 asks for the EMCY alone."""

    STOPS = 1  # as for a lost heartbeat (0x6007), and somebody has shown it: counts as a guard
    TELLS = 2  # EMCY 0x8250 and no more, which is all that CiA 301 asks for: only the loop can act on it
    MISSING = 3  # has no such sub-index, or ignores it


@dataclass(frozen=True, slots=True)
class Deviation:
    """One documented difference: what it is, the manual or thread that says so, and how servod meets it."""

    text: str
    source: str
    answer: str


@dataclass(frozen=True, slots=True)
class DeadlineSource:
    """What is known of a maker's deadline of the commands (0x1400:5): one sentence, and who says so."""

    text: str = "the manual is not known to say"
    source: str = ""


@dataclass(frozen=True, slots=True)
class Precondition:
    """A vendor object that must read `value` under `mask`, else the drive ignores us; read, never written."""

    index: int
    subindex: int
    mask: int
    value: int
    remedy: str


@dataclass(frozen=True, slots=True)
class VendorFlag:
    """A vendor object by which a drive shows something of itself: it does where this reads `value`."""

    index: int
    subindex: int
    value: int


@dataclass(frozen=True, slots=True)
class Quirks:
    """One row: how to treat a maker's drives where they differ. The defaults are the standard."""

    maker: str
    rated_torque_unit_nm: float = 1e-3  # one count of 0x6076
    interpolation_period: Presence = Presence.OPTIONAL  # 0x60C2
    interpolation_exponents: tuple[int, ...] = (-3, -4, -5, -6)  # values of 0x60C2:2 that the drive takes
    deceleration: bool = False  # 0x6085 is in the user units of 0x6064 per s^2; else the engineer sets the ramp
    command_deadline: CommandDeadline = CommandDeadline.TELLS
    deadline_source: DeadlineSource = DeadlineSource()  # for people: why `command_deadline` is what it is
    deadline_stops: VendorFlag | None = (
        None  # not all drives of the row stop at it: only one that shows this is believed
    )
    max_pdo_entries: int = 8
    pdo_pairs: int = 4  # RPDOs and TPDOs to look for; all that are not planned are set not valid
    reset_communication_at_start: bool = False
    reset_communication_after: frozenset[int] = frozenset()  # error codes that only NMT reset communication clears
    preconditions: tuple[Precondition, ...] = ()
    deviations: tuple[Deviation, ...] = ()


_MAXON = Quirks(
    maker="maxon EPOS4",
    deadline_source=DeadlineSource(
        "0x1400 has a COB-ID and a transmission type alone, so that firmware has no deadline; of later ones it is not "
        "known",
        "EDS of the EPOS4 Module 50/8, software version 0x0110 (in GitHub's lfelipem/maxon_epos4_ros1)",
    ),
    rated_torque_unit_nm=1e-6,
    interpolation_period=Presence.REQUIRED,
    reset_communication_after=frozenset({Emcy.HEARTBEAT_LOST, Emcy.ERROR_PASSIVE}),
    deviations=(
        Deviation(
            "0x6076 counts in uN*m, not mN*m",
            "EPOS4 Firmware Specification, object 0x6076 (unit column)",
            "rated_torque_unit_nm",
        ),
        Deviation(
            "cyclic modes run rough unless 0x60C2 equals the SYNC period",
            "maxon support article 4402184834322, cited in ros2_canopen issue 405",
            "interpolation_period is required and read back",
        ),
        Deviation(
            "after 0x8130 or 0x8120 the fault reset works only after NMT reset communication",
            "change log of EposLib",
            "reset_communication_after",
        ),
    ),
)

_ELMO = Quirks(
    maker="Elmo",
    deadline_source=DeadlineSource(
        "0x1400 to 0x1403 of SimplIQ have two entries, COB-ID and transmission type, so there is no deadline; of other "
        "families it is not known",
        "Elmo CANopen DS 301 Implementation Guide MAN-CAN301IG 2.1, chapter 12, objects 0x1400 - 0x1403",
    ),
    reset_communication_at_start=True,
    deviations=(
        Deviation(
            "SDO answers carry more bytes than the object has",
            "ros_canopen pull request 63",
            "answers are cut to the length that the EDS gives",
        ),
        Deviation(
            "with several drives on the bus they start properly only after NMT reset communication",
            "ros_canopen issue 67",
            "reset_communication_at_start",
        ),
        Deviation(
            "SimplIQ drives have hm, pp, ip, pv and tq, but no cyclic synchronous mode",
            "Elmo CANopen DSP 402 Implementation Guide MAN-CAN402IG 1.2, section 5.3, object 0x6502",
            "0x6502 is checked before the mode is chosen",
        ),
    ),
)

_COPLEY = Quirks(
    maker="Copley",
    preconditions=(
        Precondition(
            0x2300, 0, 0xFFFF, 30, "set the desired state 0x2300 to 30 (control by CANopen) in CME and store it"
        ),
    ),
    deviations=(
        Deviation(
            "the drive follows the bus only while its vendor object 0x2300 (desired state) selects CANopen",
            "Copley CANopen Programmer's Manual 95-00271, chapter 3, Desired State 0x2300",
            "precondition",
        ),
        Deviation(
            "no abort connection option code 0x6007 among the device control objects",
            "Copley CANopen Programmer's Manual 95-00271, chapter 3, list of device control and status objects",
            "noted in the bring-up report: the drive's own reaction to a lost heartbeat applies",
        ),
    ),
)

_NANOTEC = Quirks(
    maker="Nanotec",
    interpolation_period=Presence.REQUIRED,
    interpolation_exponents=(-3,),
    preconditions=(
        Precondition(0x3202, 0, 0x1, 0x1, "commission closed loop first (0x3202 bit 0): cst runs only in closed loop"),
    ),
    deviations=(
        Deviation(
            "0x60C2:2 takes only -3, so the cycle is whole milliseconds",
            "Nanotec PD4-E CANopen manual, Cyclic Synchronous Torque",
            "interpolation_exponents",
        ),
        Deviation(
            "cst works only in closed loop",
            "Nanotec PD4-E CANopen manual, Cyclic Synchronous Torque",
            "precondition",
        ),
        Deviation(
            "operation enabled is refused while no mode is selected (PD4-C since a firmware upgrade)",
            "ros_canopen pull request 331",
            "the mode is written before the node becomes operational",
        ),
        Deviation(
            "torque is in thousandths of what the rated current in 0x203B:1 gives",
            "Nanotec PD4-E manual, objects 0x6077 and 0x6087",
            "state amplifier.rated_torque_mnm, it is compared with 0x6076",
        ),
    ),
)

_TECHNOSOFT = Quirks(
    maker="Technosoft iPOS",
    deviations=(
        Deviation(
            "TPDOs come with an inhibit time of 30 ms, which swallows status changes",
            "roboticslab-uc3m/yarp-devices issue 232",
            "the inhibit time of every planned TPDO is written, zero unless planned",
        ),
        Deviation(
            "two control words within the slow loop's 1 ms are one: a short fault reset is not seen",
            "roboticslab-uc3m/yarp-devices issue 215 (answer of Technosoft)",
            "the fault reset is held for the handshake time, three cycles",
        ),
        Deviation(
            "changing between motion modes while enabled can make the motor jump",
            "roboticslab-uc3m/yarp-devices issue 170",
            "the mode is written only while the drive has no power",
        ),
        Deviation(
            "torque is commanded by the vendor's external reference mode where cst is missing",
            "roboticslab-uc3m/yarp-devices issues 170 and 187",
            "0x6502 is checked before the mode is chosen",
        ),
    ),
)

_CANOPENNODE = Quirks(
    maker="CANopenNode (drives built on this stack)",
    deadline_source=DeadlineSource(
        "watched, for a synchronous RPDO when SYNC comes, and told as an error; whether the node then leaves "
        "operational is up to who built it, and the power stage is not the stack's",
        "CANopenNode 9b8beed, 301/CO_PDO.c, CO_RPDO_process; CANopenNode issues 612 and 618",
    ),
    deviations=(
        Deviation(
            "the deadline 0x1400:5 of a synchronous RPDO is looked at when SYNC comes: it tells of lost commands, and "
            "never of a master that died, which ends both",
            "CANopenNode 9b8beed, 301/CO_PDO.c, CO_RPDO_process",
            "as of every drive of which nobody has shown more: the heartbeat guards",
        ),
        Deviation(
            "NMT start is not obeyed while its heartbeat consumer still misses a master that died",
            "CANopenNode 9b8beed, 301/CO_NMT_Heartbeat.c, CO_NMT_process",
            "the bring-up lets every drive forget the old watch first",
        ),
    ),
)

_VIRTUAL = Quirks(
    maker="servod's virtual drive",
    deadline_source=DeadlineSource(
        "watched; stops by 0x6007 where 0x2007 is 1, else tells of it by the EMCY 0x8250",
        "drivers/virtual/amplifier.py, commands_overdue",
    ),
    deceleration=True,
    command_deadline=CommandDeadline.STOPS,
    deadline_stops=VendorFlag(0x2007, 0, 1),
    deviations=(
        Deviation(
            "stops by 0x6007 at the deadline of its commands (0x1400:5), and does not only tell of it, if 0x2007 is 1",
            "drivers/virtual/amplifier.py, commands_overdue",
            "command_deadline: the deadline guards, the heartbeat behind it; deadline_stops: 0x2007 is read",
        ),
        Deviation(
            "its ramps 0x6084 and 0x6085 are in the unit of 0x6064 per s^2",
            "drivers/virtual/motion.py",
            "deceleration: the ramp that a stop is reckoned with is written and read back",
        ),
    ),
)

QUIRKS: dict[str, Quirks] = {
    "none": Quirks(
        maker="CiA 402",
        deceleration=True,
        deadline_source=DeadlineSource(
            "told to the device's application; there is an EMCY code for it (0x8250), and no word of what a drive does",
            "CiA 301, object 0x1400, as rtlabs-com/c-open pull request 63 reads it",
        ),
    ),
    "virtual": _VIRTUAL,
    "canopennode": _CANOPENNODE,
    "epos4": _MAXON,
    "elmo": _ELMO,
    "copley": _COPLEY,
    "nanotec": _NANOTEC,
    "technosoft": _TECHNOSOFT,
}


def load_quirks(name: str) -> Quirks:
    """The row of that name; raises BadInput with the known names."""
    if name not in QUIRKS:
        raise BadInput("amplifier.quirks", name, ", ".join(QUIRKS))
    return QUIRKS[name]
