"""The set-up face of the CiA 402 driver: what it reads, writes, and refuses, object by object."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "conformance"))
from drivers_under_test import axis_config

from servod.common.errors import BadInput, Unreachable
from servod.drivers.cia402 import Cia402Amplifier
from servod.drivers.cia402_setup import SUPPORTED_MODE_BIT, AmplifierSetup, amplifier_pdos, interpolation_period
from servod.drivers.quirks import QUIRKS, Presence, load_quirks
from servod.runtime.fieldbus.cia import Abort, Obj402
from servod.runtime.fieldbus.devices import AmplifierCommand, DriveState, Goal, Mode, NodePlan, SdoAbort

STATUS, MODES, RATED = (Obj402.STATUS_WORD, 0), (Obj402.SUPPORTED_MODES, 0), (Obj402.RATED_TORQUE, 0)
QUICK_STOP, ABORT, MODE = (Obj402.QUICK_STOP_OPTION, 0), (Obj402.ABORT_CONNECTION, 0), (Obj402.MODE, 0)
PERIOD, EXPONENT = (Obj402.INTERPOLATION_PERIOD, 1), (Obj402.INTERPOLATION_PERIOD, 2)
FAULT_REACTION = (Obj402.FAULT_REACTION_OPTION, 0)
#: The limits of a drive that nobody has set: as wide as the objects are.
LIMITS_BEFORE = {(index, 0): 0x7FFF for index in (0x6072, 0x60E0, 0x60E1, 0x6066)}
LIMITS_BEFORE |= {(index, 0): 0xFFFFFFFF for index in (0x6065, 0x607F, 0x6080)} | {
    (0x607D, 1): -(2**31),
    (0x607D, 2): 2**31 - 1,
}
CST = 1 << 9


class Dictionary(dict[tuple[int, int], int]):
    """A device's object dictionary as SDO shows it: what is not there aborts."""

    def __init__(self) -> None:
        super().__init__({STATUS: 0x0240, MODES: CST, RATED: 2000, QUICK_STOP: 2, ABORT: 0, MODE: 0})
        self.update({PERIOD: 0, EXPONENT: 0, FAULT_REACTION: 1, (0x1001, 0): 0, (0x1029, 1): 1, (0x6064, 0): 0})
        self[0x2007, 0] = 1  # by which the drive of the shipped row shows that it stops at its deadline
        self.update(LIMITS_BEFORE)
        self.written: list[tuple[int, int]] = []

    def read(self, index: int, subindex: int = 0) -> int:
        """Upload."""
        if (index, subindex) not in self:
            raise SdoAbort("no such object", Abort.NO_SUCH_OBJECT)
        return self[index, subindex]

    def write(self, index: int, subindex: int, value: int) -> None:
        """Download."""
        self.read(index, subindex)
        self.written.append((index, subindex))
        self[index, subindex] = value


def configured(device: Dictionary, mode: Mode = Mode.CYCLIC_SYNC_TORQUE, **amplifier: Any) -> NodePlan:
    return AmplifierSetup(axis_config(amplifier=amplifier), mode).configure(device)


def test_everything_that_is_wanted_is_written_and_told() -> None:
    device = Dictionary()
    plan = configured(device, quick_stop_option=6, heartbeat_reaction=3)
    assert (device[QUICK_STOP], device[ABORT], device[MODE]) == (6, 1, 10)  # it would hold for ever by 3
    assert device[PERIOD] * 10.0 ** device[EXPONENT] == pytest.approx(1e-3)
    assert device.written[-1] == MODE, "last, before the node becomes operational"
    assert (plan.facts["rated_torque_nm"], plan.facts["polarity"], plan.facts["notes"]) == (2.0, 0, [])


@pytest.mark.parametrize("state", list(DriveState))
def test_powered_drive_is_left_alone(state: DriveState) -> None:
    words = (0x0263, 0x0210, 0x0250, 0x0231, 0x0233, 0x0237, 0x0217, 0x021F, 0x0218)
    device = Dictionary()
    device[STATUS] = words[state]
    if state in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE):
        with pytest.raises(Unreachable, match=rf"is powered \({state.name}\)"):
            configured(device)
        assert device.written == []
    else:
        configured(device)


@pytest.mark.parametrize(
    ("mode", "bit"),
    [
        (Mode.PROFILE_POSITION, 0),
        (Mode.CYCLIC_SYNC_POSITION, 7),
        (Mode.CYCLIC_SYNC_VELOCITY, 8),
        (Mode.CYCLIC_SYNC_TORQUE, 9),
    ],
)
def test_mode_needs_its_bit_of_the_supported_modes(mode: Mode, bit: int) -> None:
    assert SUPPORTED_MODE_BIT[mode] == bit
    device = Dictionary()
    device[MODES] = 1 << bit
    configured(device, mode)
    device[MODES] = ~(1 << bit) & 0xFFFFFFFF
    with pytest.raises(Unreachable, match=f"{mode.name} not supported"):
        configured(device, mode)


@pytest.mark.parametrize("raw", [0, -1])
def test_rated_torque_that_is_none_is_refused(raw: int) -> None:
    device = Dictionary()
    device[RATED] = raw
    with pytest.raises(Unreachable, match=f"0x6076 reads {raw}"):
        configured(device)


def test_rated_torque_must_be_the_configured_one_to_half_its_unit() -> None:
    device = Dictionary()
    for raw, good in ((2000, True), (2001, False), (1999, False), (2_000_000, False)):
        device[RATED] = raw
        if good:
            assert configured(device).facts["rated_torque_nm"] == 2.0
        else:
            with pytest.raises(BadInput, match="0x6076"):
                configured(device)
    device[RATED] = 2001
    with pytest.raises(BadInput, match=r"0x6076 = 2001 \(2001 mN·m\).*2000 mN·m as configured"):
        configured(device)
    device[RATED] = 1
    assert configured(device, rated_torque_mnm=None).facts["rated_torque_nm"] == pytest.approx(1e-3)


def test_facts_before_the_drive_is_asked_are_in_si_units() -> None:
    facts = AmplifierSetup(axis_config()).plan().facts
    assert (facts["period_s"], facts["rated_torque_nm"]) == (pytest.approx(1e-3), pytest.approx(2.0))


@pytest.mark.parametrize(
    ("missing", "note"),
    [(ABORT, "0x6007"), (PERIOD, "0x60C2"), ((0x6080, 0), "0x6080:0"), ((0x2007, 0), "0x2007 does not show")],
)
def test_what_a_drive_does_not_have_is_told(missing: tuple[int, int], note: str) -> None:
    device = Dictionary()
    del device[missing]
    notes = configured(device).facts["notes"]
    assert [note in text for text in notes] == [True]


def test_polarity_in_the_drive_is_told_and_never_applied() -> None:
    device = Dictionary()
    device[Obj402.POLARITY, 0] = 0xC0
    plan = configured(device)
    assert (plan.facts["polarity"], plan.facts["position_direction"], plan.facts["torque_direction"]) == (0xC0, 1, 1)
    assert "0x607E polarity is 0xC0" in plan.facts["notes"][0]


@pytest.mark.parametrize("name", list(QUIRKS))
def test_preconditions_of_a_maker_are_read_and_named(name: str) -> None:
    quirks, device = load_quirks(name), Dictionary()
    device[RATED] = round(2.0 / quirks.rated_torque_unit_nm)
    for wanted in quirks.preconditions:
        device[wanted.index, wanted.subindex] = wanted.value
    configured(device, quirks=name)
    if quirks.interpolation_period is Presence.REQUIRED:
        lacking = Dictionary()
        lacking.update(device)
        del lacking[PERIOD]
        with pytest.raises(Unreachable, match="0x60C2 is missing"):
            configured(lacking, quirks=name)
    for wanted in quirks.preconditions:
        device[wanted.index, wanted.subindex] = ~wanted.value & wanted.mask
        with pytest.raises(Unreachable, match=f"0x{wanted.index:04X}:{wanted.subindex}"):
            configured(device, quirks=name)
        device[wanted.index, wanted.subindex] = wanted.value


@pytest.mark.parametrize("period_us", [1, 250, 255, 500, 1000, 2000, 4000, 10_000, 255_000])
def test_interpolation_period_is_exact_in_eight_bits(period_us: int) -> None:
    value, exponent = interpolation_period(period_us, load_quirks("none"))
    assert 0 < value <= 255
    assert value * 10 ** (6 + exponent) == period_us
    assert isinstance(value, int), "a count, as SDO takes it"


@pytest.mark.parametrize("period_us", [-1000, 0, 256, 1001, 256_001])
def test_interpolation_period_that_does_not_fit_is_refused(period_us: int) -> None:
    with pytest.raises(BadInput, match="0x60C2"):
        interpolation_period(period_us, load_quirks("none"))


def test_pdos_are_the_documented_ones() -> None:
    command, feedback, slow = amplifier_pdos(5, Mode.CYCLIC_SYNC_TORQUE, 150, 10)
    assert (command.cob_id, command.event_timer_ms, feedback.cob_id, slow.cob_id) == (0x205, 150, 0x185, 0x285)
    assert [pdo.transmission_type for pdo in (command, feedback, slow)] == [1, 1, 10]
    assert [(pdo.receive, pdo.number) for pdo in (command, feedback, slow)] == [(True, 1), (False, 1), (False, 2)]
    assert {entry.subindex for pdo in (command, feedback, slow) for entry in pdo.entries} == {0}
    assert (slow.event_timer_ms, slow.timer_ms) == (100, 0), "for a drive that knows no tenth SYNC"
    mapped = [[(entry.index, entry.bits) for entry in pdo.entries] for pdo in (command, feedback, slow)]
    assert mapped == [
        [(0x6040, 16), (0x6071, 16)],
        [(0x6041, 16), (0x6064, 32), (0x6077, 16)],
        [(0x6061, 8), (0x603F, 16)],
    ]
    slow = amplifier_pdos(5, Mode.CYCLIC_SYNC_TORQUE, 150, 10, with_inputs=True)[2]
    assert [(entry.index, entry.bits) for entry in slow.entries] == [(0x6061, 8), (0x603F, 16), (0x60FD, 32)]
    assert (slow.transmission_type, slow.timer_ms) == (255, 10), "a drive need not send it when an input changes"


@pytest.mark.parametrize(("entries", "fits"), [(3, True), (2, False)])
def test_drive_that_maps_too_few_objects_is_refused(entries: int, fits: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    few = dataclasses.replace(load_quirks("none"), max_pdo_entries=entries)
    monkeypatch.setattr("servod.drivers.cia402_setup.load_quirks", lambda _name: few)
    setup = AmplifierSetup(axis_config())
    if fits:
        assert len(setup.plan().pdos) == 3
    else:
        with pytest.raises(BadInput, match="maps 3 objects in one PDO"):
            setup.plan()


OUTPUTS, MASK = (0x60FE, 1), (0x60FE, 2)


@pytest.mark.parametrize(("engages", "closed"), [("low", 0), ("high", 1 << 5)])
def test_the_brake_is_closed_before_its_output_is_taken(engages: str, closed: int) -> None:
    device = Dictionary()
    device.update({OUTPUTS: 0b100100, MASK: 0b1000})
    plan = configured(device, brake={"by": "output", "output_bit": 5, "output_engages": engages})
    assert (device[OUTPUTS], device[MASK]) == (0b100 | closed, 0b101000), "the other outputs stay as they are"
    places = [device.written.index(place) for place in (OUTPUTS, MASK)]
    assert places == sorted(places)
    command = next(pdo for pdo in plan.pdos if pdo.receive)
    assert [entry.word for entry in command.entries] == [0x60400010, 0x60710010, 0x60FE0120]
    driver = Cia402Amplifier(plan)
    sent = {driver.write(AmplifierCommand(goal, 0.0))[1][-4:] for goal in Goal}
    assert sent == {(0b100 | closed).to_bytes(4, "little")}, "each cycle, too"
    assert plan.facts["brake"] == (0b100 | closed, 0b100 | closed ^ 1 << 5)


def test_a_drive_without_outputs_cannot_have_the_brake() -> None:
    with pytest.raises(Unreachable, match=r"0x60FE is missing, needed for amplifier\.brake"):
        configured(Dictionary(), brake={"by": "output", "output_bit": 5})
    device = Dictionary()
    device[OUTPUTS] = 0b100100  # a drive without the mask, which is optional
    assert configured(device, brake={"by": "output", "output_bit": 5}).facts["brake"] == (0b100, 0b100100)
    assert device[OUTPUTS] == 0b100
    assert all(len(pdo.entries) == 2 for pdo in configured(Dictionary(), brake={"by": "drive"}).pdos if pdo.receive)
