"""The bring-up against canopen's own node: order, read-back, refusals. Every refusal names what was found."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from canopen import SdoAbortedError
from rig import Rig
from witness import Witness, axis_config, master, witness

from servod.common.errors import BadInput, Unreachable
from servod.runtime.fieldbus.cia import Obj301, Obj402, Obj406
from servod.runtime.fieldbus.devices import SdoAbort


@pytest.fixture
def world() -> Iterator[Witness]:
    with witness() as instance:
        yield instance


class Writes:
    """Every SDO write that a local node takes, in order."""

    def __init__(self, *nodes: Any) -> None:
        self.seen: list[tuple[int, int, int]] = []
        for node in nodes:
            node.add_write_callback(self._write)

    def _write(self, *, index: int, subindex: int, od: Any, data: bytes) -> None:
        self.seen.append((index, subindex, int.from_bytes(data, "little")))

    def first(self, index: int, subindex: int = 0) -> int:
        return next(at for at, entry in enumerate(self.seen) if entry[:2] == (index, subindex))


def refuse(world: Witness, error: type[Exception], match: str, **sections: Any) -> None:
    """Bring up with this configuration must end in this error."""
    with master(world, axis_config(**sections)) as instance, pytest.raises(error, match=match):
        instance.bring_up()


@pytest.mark.parametrize("threaded", [True, False])
def test_both_nodes_become_operational_and_watch_each_other(world: Witness, threaded: bool) -> None:
    with master(world, axis_config(), threaded) as instance:
        up = instance.bring_up()
    assert world.amplifier.nmt.state == world.encoder.nmt.state == "OPERATIONAL"
    assert world.amplifier.sdo[0x1016][1].raw == 126 << 16 | 100
    assert world.amplifier.sdo[0x1017].raw == world.encoder.sdo[0x1017].raw == 50
    assert up.amplifier.facts["rated_torque_nm"] == world.amplifier.sdo[0x6076].raw * 1e-3
    assert up.encoder.facts["measuring_range_counts"] == world.encoder.sdo[0x6002].raw
    assert 0.3 < up.bus_load < 0.5


def test_parameters_are_what_the_configuration_says(world: Witness) -> None:
    config = axis_config(amplifier={"quick_stop_option": 6, "heartbeat_reaction": 1}, cycle={"period_us": 2500})
    with master(world, config) as instance:
        instance.bring_up()
    sdo = world.amplifier.sdo
    assert (sdo[Obj402.QUICK_STOP_OPTION].raw, sdo[Obj402.ABORT_CONNECTION].raw) == (6, 1)
    assert (sdo[Obj402.INTERPOLATION_PERIOD][1].raw, sdo[Obj402.INTERPOLATION_PERIOD][2].raw) == (25, -4)
    assert sdo[Obj402.MODE].raw == 10


def test_the_mapping_is_written_by_the_sequence_of_cia_301(world: Witness) -> None:
    writes = Writes(world.amplifier)
    with master(world, axis_config()) as instance:
        instance.bring_up()
    steps = [entry for entry in writes.seen if entry[0] in (0x1400, 0x1600)]
    assert [entry[:2] for entry in steps] == [
        (0x1400, 1),
        (0x1600, 0),
        (0x1600, 1),
        (0x1600, 2),
        (0x1600, 0),
        (0x1400, 2),
        (0x1400, 5),
        (0x1400, 1),
    ]
    assert steps[0][2] >> 31 == 1
    assert steps[1][2] == 0
    assert steps[-1][2] & ~0x40000000 == 0x201
    forgets, watches = (at for at, entry in enumerate(writes.seen) if entry[:2] == (Obj301.HEARTBEAT_CONSUMER, 1))
    assert [writes.seen[at][2] for at in (forgets, watches)] == [0, 126 << 16 | 100]
    assert forgets < writes.first(Obj402.MODE) < writes.first(0x1400, 1) < watches


@pytest.mark.parametrize("refuses", [True, False])
def test_a_drive_without_every_nth_sync_sends_by_events(world: Witness, refuses: bool) -> None:
    """Some know types 1 and 255 alone: they say so, or keep the one they had."""
    kept = [255]

    def write(*, index: int, subindex: int, od: Any, data: bytes) -> None:
        if (index, subindex) == (0x1801, 2):
            if data[0] in (1, 255):
                kept[0] = data[0]
            elif refuses:
                raise SdoAbortedError(0x06090030)

    def read(*, index: int, subindex: int, od: Any) -> int | None:
        return kept[0] if (index, subindex) == (0x1801, 2) else None

    world.amplifier.add_write_callback(write)
    world.amplifier.add_read_callback(read)
    with master(world, axis_config()) as instance:
        up = instance.bring_up()
    _, feedback, slow = up.amplifier.pdos
    assert (feedback.transmission_type, slow.transmission_type, slow.timer_ms) == (1, 255, 100)
    assert world.amplifier.sdo[0x1801][5].raw == 100
    assert "node 1: TPDO2 by events: it sends none with every n-th SYNC" in up.report
    assert up.encoder.pdos[0].transmission_type == world.encoder.sdo[0x1800][2].raw == 10


def test_pdos_that_are_not_planned_are_switched_off(world: Witness) -> None:
    world.amplifier.sdo[0x1402][1].raw = 0x401
    with master(world, axis_config()) as instance:
        report = instance.bring_up().report
    assert world.amplifier.sdo[0x1402][1].raw >> 31 == 1
    assert any("0x1402" in line for line in report)


@pytest.mark.parametrize(("key", "value"), [("vendor_id", 1), ("product_code", 2), ("revision", 3), ("serial", 4)])
@pytest.mark.parametrize("section", ["amplifier", "encoder"])
def test_another_device_is_refused_before_anything_is_written(
    world: Witness, section: str, key: str, value: int
) -> None:
    writes = Writes(world.amplifier, world.encoder)
    message = rf"{key} \(0x1018:{value}\) .*0x{value + 0xABC:08X}.*nothing was written"
    refuse(world, Unreachable, message, **{section: {"identity": {key: value + 0xABC}}})
    assert writes.seen == []


def test_a_device_of_another_profile_is_refused(world: Witness) -> None:
    message = r"profile .* is 406, the driver needs 402"
    refuse(world, Unreachable, message, amplifier={"node_id": 2}, encoder={"node_id": 1})


def test_too_much_bus_load_is_refused_before_anything_is_written(world: Witness) -> None:
    writes = Writes(world.amplifier, world.encoder)
    refuse(world, BadInput, r"160.0 % of 250000 bit/s", bus={"bit_rate": 250_000})
    assert writes.seen == []


@pytest.mark.parametrize(
    ("index", "subindex", "kept", "message"),
    [
        (0x1600, 2, 0x60710020, r"RPDO1, object 0x1600:2: wrote 0x60710010, device reads 0x60710020"),
        (0x1A00, 0, 2, r"TPDO1, object 0x1A00:0: wrote 0x00000003, device reads 0x00000002"),
        (0x1800, 2, 255, r"TPDO1, object 0x1800:2: wrote 0x00000001, device reads 0x000000FF"),
        (0x1801, 5, 10, r"TPDO2, object 0x1801:5: wrote 0x00000000, device reads 0x0000000A"),
        (0x1801, 3, 300, r"TPDO2, object 0x1801:3: wrote 0x00000000, device reads 0x0000012C"),
        (0x1800, 5, 20, r"TPDO1, object 0x1800:5: wrote 0x00000000, device reads 0x00000014"),
        (0x1400, 5, 0, r"object 0x1400:5: wrote 20, device reads 0"),
        (0x1400, 1, 0x80000201, r"RPDO1, object 0x1400:1: wrote 0x00000201, device reads 0x80000201"),
        (0x605A, 0, 0, r"0x605A:0: wrote 2, device reads 0"),
        (0x6060, 0, 8, r"0x6060:0: wrote 10, device reads 8"),
        (0x1017, 0, 7, r"0x1017:0: wrote 50, device reads 7"),
        (0x1016, 1, 0, r"0x1016:1: wrote 8257636, device reads 0"),
    ],
)
def test_a_device_that_keeps_something_else_is_found(
    world: Witness, index: int, subindex: int, kept: int, message: str
) -> None:
    def answer(*, index: int, subindex: int, od: Any, _wanted: tuple[int, int] = (index, subindex)) -> int | None:
        return kept if (index, subindex) == _wanted else None

    world.amplifier.add_read_callback(answer)
    refuse(world, Unreachable, message)
    assert world.amplifier.nmt.state != "OPERATIONAL"


def test_a_drive_without_a_deadline_is_reported(world: Witness) -> None:
    del world.amplifier.object_dictionary[0x1400].subindices[5]
    with master(world, axis_config()) as instance:
        report = instance.bring_up().report
    assert "node 1: no command deadline counts, the heartbeat guards alone: 100 ms (0x1016)" in report


@pytest.mark.parametrize("status_word", [0x0237, 0x0217, 0x021F])
def test_nothing_is_written_to_a_powered_drive(world: Witness, status_word: int) -> None:
    world.amplifier.sdo[Obj402.STATUS_WORD].raw = status_word
    writes = Writes(world.amplifier)
    refuse(world, Unreachable, "is powered")
    assert writes.seen == []


def test_a_mode_that_the_drive_does_not_support_is_refused(world: Witness) -> None:
    world.amplifier.sdo[Obj402.SUPPORTED_MODES].raw = 0x65
    refuse(world, Unreachable, r"CYCLIC_SYNC_TORQUE not supported .*0x00000065")


def test_rated_torque_must_be_what_is_configured(world: Witness) -> None:
    world.amplifier.sdo[Obj402.RATED_TORQUE].raw = 640
    message = r"rated_torque_mnm: found 0x6076 = 640 \(640 mN·m\)"
    refuse(world, BadInput, message, amplifier={"rated_torque_mnm": 100})


@pytest.mark.parametrize(
    ("scaling", "key", "index"),
    [(4, "counts_per_turn", 0x6001), (0, "counts_per_turn", 0x6501), (4, "measuring_range_counts", 0x6002)],
)
def test_the_encoder_must_be_what_is_configured(world: Witness, scaling: int, key: str, index: int) -> None:
    world.encoder.sdo[Obj406.OPERATING_PARAMETERS].raw = scaling
    reads = world.encoder.sdo[index].raw
    message = rf"encoder.{key}: found 4096; allowed: {reads}, what 0x{index:04X} reads"
    refuse(world, BadInput, message, encoder={key: 4096})


def test_a_scaled_encoder_counts_by_its_scaling(world: Witness) -> None:
    world.encoder.sdo[Obj406.OPERATING_PARAMETERS].raw = 1 << 2
    world.encoder.sdo[Obj406.UNITS_PER_TURN].raw = 36_000
    with master(world, axis_config(encoder={"counts_per_turn": 36_000})) as instance:
        assert instance.bring_up().encoder.facts["counts_per_turn"] == 36_000


def test_a_node_that_is_not_there_is_unreachable(world: Witness) -> None:
    refuse(world, Unreachable, r"node 9 object 0x1000:0: read failed", encoder={"node_id": 9})


def test_a_node_that_stays_pre_operational_is_found(world: Witness) -> None:
    world.encoder.nmt.on_command = lambda *_: None
    world.network.subscribers[0] = [c for c in world.network.subscribers[0] if c.__self__ is not world.encoder.nmt]
    refuse(world, Unreachable, r"node 2: not operational after 1 s \(state 127\)")


def test_an_orderly_end_lets_the_drive_forget_us(world: Witness) -> None:
    with master(world, axis_config()) as instance:
        instance.bring_up()
        instance.stand_down()
        assert instance.events() == []
    assert world.amplifier.sdo[0x1016][1].raw == 0
    assert world.amplifier.nmt.state == "PRE-OPERATIONAL"


def test_a_second_bring_up_finds_everything_in_place(world: Witness) -> None:
    for _ in range(2):
        with master(world, axis_config()) as instance:
            instance.bring_up()
            instance.stand_down()
    with master(world, axis_config()) as instance:
        assert instance.bring_up().amplifier.facts["mode"] == 10


def test_sdo_access_to_another_node_is_bad_input(world: Witness) -> None:
    with master(world, axis_config()) as instance, pytest.raises(BadInput, match="1 or 2"):
        instance.sdo(3)


def test_aborts_carry_code_and_meaning(world: Witness) -> None:
    message = r"node 1 object 0x5FFF:0: read refused, 0x06020000 .*no such object"
    with master(world, axis_config()) as instance, pytest.raises(SdoAbort, match=message) as abort:
        instance.sdo(1).read(0x5FFF)
    assert abort.value.code == 0x06020000


def test_the_identity_reads_as_scan_shows_it() -> None:
    rig = Rig()
    rig.start()
    assert any("product 0x406, revision 0x" in line for line in rig.up.report)
