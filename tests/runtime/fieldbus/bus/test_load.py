"""Bus load: the worst-case frame lengths, the rates by transmission type, and the refusal with its figures."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servod.common.errors import BadInput
from servod.formats.config import AxisConfig
from servod.runtime.fieldbus.devices import PdoEntry, PdoMap
from servod.runtime.fieldbus.master.planned import bus_load, check_bus_load, pdo_rate_per_s, worst_case_bits
from servod.runtime.fieldbus.registry import load_driver
from tests.axis_limits import LIMITS


def load_of(**sections: Any) -> tuple[AxisConfig, Any]:
    config = AxisConfig.model_validate({"limits": LIMITS, "gains": {"initial": "g.yaml"}} | sections)
    plans = [load_driver(name).setup(config).plan() for name in ("cia402", "cia406")]
    return config, bus_load(config, plans)


@pytest.mark.parametrize(("data_bytes", "bits"), [(0, 55), (1, 65), (4, 95), (8, 135)])
def test_worst_case_frame_lengths(data_bytes: int, bits: int) -> None:
    assert worst_case_bits(data_bytes) == bits


@given(st.binary(max_size=8), st.integers(0, 0x7FF))
def test_no_real_frame_is_longer_than_the_worst_case(data: bytes, can_id: int) -> None:
    """The bits of a frame, stuffed bit by bit as ISO 11898-1 says, never exceed the formula."""
    header = f"0{can_id:011b}000{len(data):04b}"
    stuffed = header + "".join(f"{byte:08b}" for byte in data)
    stuffed += f"{_crc15(stuffed):015b}"
    stuff_bits, run, last = 0, 0, ""
    for bit in stuffed:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuff_bits, last, run = stuff_bits + 1, "1" if bit == "0" else "0", 1
    unstuffed_tail = 3 + 7 + 3  # CRC delimiter and acknowledge, end of frame, interframe space
    assert len(stuffed) + stuff_bits + unstuffed_tail <= worst_case_bits(len(data))


def _crc15(bits: str) -> int:
    crc = 0
    for bit in bits:
        feedback = int(bit) ^ crc >> 14
        crc = crc << 1 & 0x7FFF ^ (0x4599 if feedback else 0)
    return crc


def test_one_axis_at_one_megabit_uses_what_the_budget_says() -> None:
    _, load = load_of()
    cyclic = sum(item.bits_per_s for item in load.items if item.frames_per_s == 1000.0)
    assert cyclic == 380_000
    assert 0.39 < load.share < 0.41


@pytest.mark.parametrize(
    ("transmission_type", "timer_ms", "inhibit", "rate"),
    [
        (0, 0, 0, 1000.0),
        (1, 0, 0, 1000.0),
        (4, 0, 0, 250.0),
        (255, 100, 0, 10.0),
        (254, 0, 50, 200.0),
        (255, 0, 0, 1e3),
    ],
)
def test_rate_of_a_tpdo(transmission_type: int, timer_ms: int, inhibit: int, rate: float) -> None:
    pdo = PdoMap(False, 1, 0x181, transmission_type, (PdoEntry(0x6041, 0, 16),), timer_ms, inhibit)
    assert pdo_rate_per_s(pdo, 1e-3) == pytest.approx(rate)


def test_too_much_is_refused_with_all_figures() -> None:
    config, load = load_of(bus={"bit_rate": 500_000})
    with pytest.raises(BadInput) as refusal:
        check_bus_load(load, config.bus.max_load)
    message = str(refusal.value)
    assert "80.0 % of 500000 bit/s" in message
    assert "node 1 TPDO1 135 bit x 1000/s = 27.0 %" in message
    assert "at most bus.max_load = 70 %" in message


def test_a_slower_cycle_fits_the_slower_bus() -> None:
    config, load = load_of(bus={"bit_rate": 500_000}, cycle={"period_us": 2000})
    check_bus_load(load, config.bus.max_load)
    assert load.share < 0.43
