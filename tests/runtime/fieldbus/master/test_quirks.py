"""The quirks of real drives act: each field changes what is written, read or refused."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from witness import EDS, Witness, axis_config, master, witness

from servod.common.errors import BadInput, Unreachable
from servod.drivers.cia402_setup import interpolation_period
from servod.drivers.quirks import QUIRKS, CommandDeadline, load_quirks

MAKERS = [name for name in QUIRKS if name != "none"]


@pytest.fixture
def world() -> Iterator[Witness]:
    with witness() as instance:
        yield instance


def test_the_makers_of_the_field_are_there() -> None:
    assert set(MAKERS) >= {"epos4", "elmo", "copley", "nanotec", "technosoft"}


@pytest.mark.parametrize("name", MAKERS)
def test_every_deviation_names_its_source_and_our_answer(name: str) -> None:
    row = load_quirks(name)
    assert len(row.deviations) >= 2
    assert all(deviation.text and deviation.source and deviation.answer for deviation in row.deviations)


@pytest.mark.parametrize("name", list(QUIRKS))
def test_what_is_known_of_the_deadline_has_a_source_or_is_said_to_be_unknown(name: str) -> None:
    row = load_quirks(name)
    told = row.deadline_source
    assert bool(told.source) is (told.text != "the manual is not known to say")
    assert told.source or row.command_deadline is CommandDeadline.TELLS, "what nobody says is not acted on"


def test_an_unknown_row_says_the_known_ones() -> None:
    with pytest.raises(BadInput, match=r"found acme; allowed: none, .*epos4"):
        load_quirks("acme")


def test_rated_torque_counts_in_micronewtonmetres(world: Witness) -> None:
    world.amplifier.sdo[0x6076].raw = 640_000
    config = axis_config(amplifier={"quirks": "epos4", "rated_torque_mnm": 640})
    with master(world, config) as instance:
        assert instance.bring_up().amplifier.facts["rated_torque_nm"] == pytest.approx(0.64)


@pytest.mark.parametrize(
    ("maker", "period_us", "expected"),
    [("none", 1000, (1, -3)), ("none", 500, (5, -4)), ("none", 1250, (125, -5)), ("nanotec", 2000, (2, -3))],
)
def test_interpolation_period_is_exact(maker: str, period_us: int, expected: tuple[int, int]) -> None:
    value, exponent = interpolation_period(period_us, QUIRKS[maker])
    assert (value, exponent) == expected
    assert round(value * 10.0 ** (6 + exponent)) == period_us


@pytest.mark.parametrize(("maker", "period_us"), [("nanotec", 1500), ("none", 19_999)])
def test_a_period_that_the_drive_cannot_express_is_refused(maker: str, period_us: int) -> None:
    with pytest.raises(BadInput, match=r"cycle.period_us"):
        interpolation_period(period_us, QUIRKS[maker])


def eds_without(tmp_path: Path, section: str) -> str:
    """The shipped amplifier without one object: a drive that lacks it."""
    keep, out = True, []
    for line in (EDS / "amplifier.eds").read_text().splitlines():
        if line.startswith("["):
            keep = not line.lower().startswith(f"[{section.lower()}")
        if keep:
            out.append(line)
    path = tmp_path / "less.eds"
    path.write_text("\n".join(out) + "\n")
    return str(path)


def test_a_required_object_that_is_missing_ends_the_bring_up(world: Witness, tmp_path: Path) -> None:
    config = axis_config(amplifier={"quirks": "epos4", "eds": eds_without(tmp_path, "60C2")})
    with master(world, config) as instance, pytest.raises(Unreachable, match="0x60C2 is missing"):
        instance.bring_up()


@pytest.mark.parametrize(("section", "note"), [("60C2", "no 0x60C2"), ("6007", "no 0x6007"), ("6080", "no 0x6080:0")])
def test_an_optional_object_that_is_missing_is_reported(
    world: Witness, tmp_path: Path, section: str, note: str
) -> None:
    world.amplifier.object_dictionary.indices.pop(int(section, 16))
    with master(world, axis_config(amplifier={"eds": eds_without(tmp_path, section), "unguarded": True})) as instance:
        assert any(note in line for line in instance.bring_up().report)


@pytest.mark.parametrize(("maker", "index"), [("copley", 0x2300), ("nanotec", 0x3202)])
def test_a_precondition_that_is_not_met_names_the_remedy(world: Witness, maker: str, index: int) -> None:
    world.amplifier.add_read_callback(lambda *, index, subindex, od, at=index: 0 if index == at else None)
    (precondition,) = QUIRKS[maker].preconditions
    variable = world.amplifier.object_dictionary[0x6080]
    world.amplifier.object_dictionary.indices[index] = variable
    config = axis_config(amplifier={"quirks": maker})
    with master(world, config) as instance, pytest.raises(Unreachable) as refusal:
        instance.bring_up()
    assert f"0x{index:04X}:0 reads 0; {precondition.remedy}" in str(refusal.value)


class Rebooter:
    """A node's answer to NMT reset communication: its boot-up message, which LocalNode sends for itself."""

    def __init__(self, world: Witness) -> None:
        self.resets = 0
        self._bus = world.raw()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            message = self._bus.recv(0.02)
            if message is not None and message.arbitration_id == 0 and bytes(message.data) == b"\x82\x01":
                self.resets += 1
                self._bus.send(can.Message(arbitration_id=0x701, data=b"\x00", is_extended_id=False))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()


@pytest.mark.parametrize(
    ("maker", "last_error", "resets"),
    [("elmo", 0, 1), ("epos4", 0x8130, 1), ("epos4", 0x7305, 0), ("none", 0x8130, 0)],
)
def test_communication_is_reset_where_the_quirks_ask(world: Witness, maker: str, last_error: int, resets: int) -> None:
    world.amplifier.sdo[0x1003][1].raw = last_error
    rebooter = Rebooter(world)
    try:
        with master(world, axis_config(amplifier={"quirks": maker})) as instance:
            report = instance.bring_up().report
    finally:
        rebooter.close()
    assert rebooter.resets == resets
    assert any("communication reset" in line for line in report) == bool(resets)


def test_a_reset_without_boot_up_is_unreachable(world: Witness) -> None:
    world.network.subscribers[0] = []
    config, message = axis_config(amplifier={"quirks": "elmo"}), "node 1: no boot-up 2 s after reset communication"
    with master(world, config) as instance, pytest.raises(Unreachable, match=message):
        instance.bring_up()
