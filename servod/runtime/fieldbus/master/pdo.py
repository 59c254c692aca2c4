"""Writes PDO mappings by the sequence of CiA 301, reads everything back and compares. Off the control path.

A wrong mapping is the worst kind of error: the drive accepts it and every value after it is plausible garbage. So the
lengths are checked against the EDS before, and the device's own answer against the plan after.
"""

from __future__ import annotations

from servod.common.errors import BadInput, Unreachable
from servod.runtime.fieldbus.cia import PDO_NO_RTR, PDO_NOT_VALID, Obj301
from servod.runtime.fieldbus.devices import NodePlan, PdoMap, SdoAbort, SdoAccess
from servod.runtime.fieldbus.master.eds import Dictionary
from servod.runtime.fieldbus.setup_tools import read_optional, write_checked

_COB_ID, _TYPE, _INHIBIT, _EVENT_TIMER = 1, 2, 3, 5  # sub-indices of 1400/1800
_COMPARED_COB_BITS = ~PDO_NO_RTR & 0xFFFFFFFF  # bit 30 is the device's own business
_FIRST_DATA_OBJECT = 0x20  # indices below are the dummy types that fill gaps


def parameter_index(pdo: PdoMap) -> int:
    """Index of the communication parameter (0x1400 or 0x1800 and up)."""
    return (Obj301.RPDO_PARAMETER if pdo.receive else Obj301.TPDO_PARAMETER) + pdo.number - 1


def mapping_index(pdo: PdoMap) -> int:
    """Index of the mapping (0x1600 or 0x1A00 and up)."""
    return (Obj301.RPDO_MAPPING if pdo.receive else Obj301.TPDO_MAPPING) + pdo.number - 1


def check_lengths(plan: NodePlan, dictionary: Dictionary) -> None:
    """Raise BadInput when a mapped object is not in the EDS, or has another length there."""
    for pdo in plan.pdos:
        for entry in pdo.entries:
            if entry.index < _FIRST_DATA_OBJECT:
                continue
            name = f"0x{entry.index:04X}:{entry.subindex}"
            variable = dictionary.objects.get_variable(entry.index, entry.subindex)
            if variable is None:
                raise BadInput(dictionary.source, f"no object {name}", f"the object: driver {plan.driver} maps it")
            if len(variable) != entry.bits:
                raise BadInput(dictionary.source, f"object {name} with {len(variable)} bits", f"{entry.bits} bits")


def write_pdo(sdo: SdoAccess, pdo: PdoMap) -> bool:
    """Write one PDO: not valid, mapping off, entries, mapping on, parameters, valid; False when it has no deadline."""
    parameter, mapping = parameter_index(pdo), mapping_index(pdo)
    present = sdo.read(parameter, _COB_ID)
    sdo.write(parameter, _COB_ID, present | PDO_NOT_VALID)
    sdo.write(mapping, 0, 0)
    for place, entry in enumerate(pdo.entries, start=1):
        sdo.write(mapping, place, entry.word)
    sdo.write(mapping, 0, len(pdo.entries))
    sdo.write(parameter, _TYPE, pdo.transmission_type)
    for subindex, wanted, found in timers(sdo, pdo):
        if found != wanted:
            sdo.write(parameter, subindex, wanted)
    guarded = not pdo.receive or write_deadline(sdo, pdo)
    sdo.write(parameter, _COB_ID, pdo.cob_id | present & PDO_NO_RTR)
    return guarded


def timers(sdo: SdoAccess, pdo: PdoMap) -> list[tuple[int, int, int]]:
    """Rows of (sub-index, wanted, present) of a TPDO's timers, as far as the device has them; none of an RPDO's.

    A default inhibit time is cleared: it would swallow changes that come too close together. Raises Unreachable when
    a timer is wanted and missing.
    """
    rows = []
    for subindex, wanted in () if pdo.receive else ((_INHIBIT, pdo.inhibit_100us), (_EVENT_TIMER, pdo.event_timer_ms)):
        present = read_optional(sdo, parameter_index(pdo), subindex)
        if present is not None:
            rows.append((subindex, wanted, present))
        elif wanted:
            raise Unreachable(f"object 0x{parameter_index(pdo):04X}:{subindex} is missing, needed for {wanted}")
    return rows


def write_deadline(sdo: SdoAccess, pdo: PdoMap) -> bool:
    """Write and read back the deadline of an RPDO; False when the device or its EDS has none, or it is not writable.

    CiA 301: EMCY 8250 when the next RPDO does not come in time. A guard beside the heartbeat, so a device may lack it.
    """
    index = parameter_index(pdo)
    try:
        if sdo.read(index, _EVENT_TIMER) != pdo.event_timer_ms:
            write_checked(sdo, index, _EVENT_TIMER, pdo.event_timer_ms)
    except SdoAbort:
        return False
    return True


def expected(sdo: SdoAccess, pdo: PdoMap) -> list[tuple[int, int, int, int]]:
    """What must be read back, all that was written: rows of (index, subindex, mask, value)."""
    parameter, mapping = parameter_index(pdo), mapping_index(pdo)
    rows = [
        (parameter, _COB_ID, _COMPARED_COB_BITS, pdo.cob_id),
        (parameter, _TYPE, 0xFF, pdo.transmission_type),
        (mapping, 0, 0xFF, len(pdo.entries)),
    ]
    rows += [(mapping, place, 0xFFFFFFFF, entry.word) for place, entry in enumerate(pdo.entries, start=1)]
    return rows + [(parameter, subindex, 0xFFFF, wanted) for subindex, wanted, _ in timers(sdo, pdo)]


def verify_pdo(sdo: SdoAccess, node_id: int, pdo: PdoMap) -> None:
    """Read one PDO back and compare; raises Unreachable naming object, wrote and read."""
    for index, subindex, mask, value in expected(sdo, pdo):
        read = sdo.read(index, subindex)
        if read & mask != value:
            name = f"node {node_id} {'R' if pdo.receive else 'T'}PDO{pdo.number}, object 0x{index:04X}:{subindex}"
            raise Unreachable(f"{name}: wrote 0x{value:08X}, device reads 0x{read:08X}")


def disable_other_pdos(sdo: SdoAccess, plan: NodePlan) -> list[int]:
    """Set every PDO that is not planned to not valid; the parameter indices that were valid before.

    `plan.facts["pdo_pairs"]` says how many the device may have; one that does not exist ends the count.
    """
    planned = {parameter_index(pdo) for pdo in plan.pdos}
    switched_off = []
    for first in (Obj301.RPDO_PARAMETER, Obj301.TPDO_PARAMETER):
        for index in range(first, first + int(plan.facts.get("pdo_pairs", 4))):
            if index in planned:
                continue
            cob_id = read_optional(sdo, index, _COB_ID)
            if cob_id is not None and not cob_id & PDO_NOT_VALID:
                sdo.write(index, _COB_ID, cob_id | PDO_NOT_VALID)
                switched_off.append(index)
    return switched_off


def configure_pdos(sdo: SdoAccess, plan: NodePlan, dictionary: Dictionary) -> list[str]:
    """Check, write and verify all PDOs of a plan; lines for the report."""
    check_lengths(plan, dictionary)
    switched_off = disable_other_pdos(sdo, plan)
    unguarded = [pdo for pdo in plan.pdos if not write_pdo(sdo, pdo) and pdo.event_timer_ms]
    for pdo in plan.pdos:
        verify_pdo(sdo, plan.node_id, pdo)
    report = [f"node {plan.node_id}: {len(plan.pdos)} PDOs written and read back"]
    report += [f"node {plan.node_id} RPDO{pdo.number}: no deadline, the heartbeat guards alone" for pdo in unguarded]
    if switched_off:
        report.append(f"node {plan.node_id}: switched off {', '.join(f'0x{i:04X}' for i in switched_off)}")
    return report
