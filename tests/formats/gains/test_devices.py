"""A set made of what was measured with one drive and encoder, on an axis that has others."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.common.yaml import parse_yaml
from servod.formats.config import AxisConfig, load_config
from servod.formats.gains.gain_set import GainSet, devices_of, load_gains, require_devices, require_same_loop
from servod.formats.model.identified import Devices
from servod.runtime.daemon.arguments import GainsActivateArgs
from servod.runtime.daemon.gain_bank import GainBank
from servod.runtime.loop.commands import Op

OWN = {"amplifier": {"vendor_id": 0x2E8, "serial": 4711}, "encoder": {"product_code": 7, "serial": 4712}}
KEY = "design.model.identified.devices"


def identified_with(devices: dict[str, Any] | None) -> GainSet:
    """The shipped set, as if its model had been identified with these devices."""
    gains = load_gains(shipped("gains/demo_local_certified.yaml"))
    assert gains.design is not None and gains.design.model.identified is not None
    found = None if devices is None else Devices.model_validate(devices)
    identified = gains.design.model.identified.model_copy(update={"devices": found})
    model = gains.design.model.model_copy(update={"identified": identified})
    return gains.model_copy(update={"design": gains.design.model_copy(update={"model": model})})


def configured(accept_uncertified: bool = False, **identities: dict[str, Any]) -> AxisConfig:
    """The configuration of the shipped set's axis, which states these identities."""
    config = load_config(shipped("gains/config/virtual.yaml"))
    document = config.model_dump(mode="json")
    for role, identity in identities.items():
        document[role]["identity"] = identity
    document["gains"]["accept_uncertified"] = accept_uncertified
    return AxisConfig.model_validate(document)


@pytest.mark.parametrize(
    ("role", "key", "other"), [("amplifier", "serial", 9), ("encoder", "serial", 9), ("amplifier", "vendor_id", 1)]
)
def test_a_set_of_other_devices_is_refused_by_the_key_that_differs(role: str, key: str, other: int) -> None:
    seen = Devices.model_validate(OWN | {role: OWN[role] | {key: other}})
    with pytest.raises(BadInput) as refused:
        require_devices(identified_with(OWN), seen, configured(), "set.yaml")
    own = OWN[role][key]
    assert f"set.yaml: {KEY}.{role}.{key}: found {own}; allowed: {other}, as the axis has it" in str(refused.value)
    require_devices(identified_with(OWN), seen, configured(accept_uncertified=True))


@pytest.mark.parametrize("devices", [None, {}, {"amplifier": {"vendor_id": 0x2E8}}, OWN])
def test_what_one_of_both_does_not_say_is_not_compared(devices: dict[str, Any] | None) -> None:
    require_devices(identified_with(devices), Devices.model_validate(OWN), configured())
    require_devices(identified_with(OWN), Devices(), configured())


def test_the_loop_of_a_configuration_that_states_another_serial_number_is_another_loop() -> None:
    gains = identified_with(OWN)
    require_same_loop(gains, configured(encoder={"serial": 4712}))
    with pytest.raises(BadInput, match=f"{KEY}.encoder.serial: found 4712; allowed: 4713"):
        require_same_loop(gains, configured(encoder={"serial": 4713}))
    assert devices_of(configured(encoder={"serial": 4713})).encoder.serial == 4713


def test_a_set_keeps_its_devices_through_its_file(tmp_path: Path) -> None:
    file = tmp_path / "set.yaml"
    file.write_text(identified_with(OWN).to_yaml())
    known = parse_yaml(file.read_text(), "set")["design"]["model"]["identified"]["devices"]
    assert known["amplifier"]["serial"] == 4711
    loaded = load_gains(file).design
    assert loaded is not None and loaded.model.identified is not None
    assert loaded.model.identified.devices == Devices.model_validate(OWN)


async def _no_loop(_op: Op, _arguments: Sequence[float]) -> Any:
    pytest.fail("the set went to the loop")


def test_an_axis_that_found_other_devices_runs_no_set_of_these(tmp_path: Path) -> None:
    """Neither the one it starts with nor one that is activated, whatever else fits."""
    initial = tmp_path / "initial.yaml"
    initial.write_text(identified_with(OWN).model_copy(update={"certificate": None}).sealed().to_yaml())
    config = configured()
    gains = config.gains.model_copy(update={"directory": tmp_path / "store", "initial": initial})
    bank = GainBank(config.model_copy(update={"gains": gains}), lambda _gains, _config: None)
    bank.require_own_devices()  # nobody has asked the nodes yet
    bank.know(Devices.model_validate(OWN))
    bank.require_own_devices()
    name = bank.newest.name
    bank.know(Devices.model_validate(OWN | {"amplifier": {"serial": 1}}))
    assert f"{KEY}.amplifier.serial" in bank.describe(0)["note"]
    with pytest.raises(BadInput, match=r"amplifier\.serial: found 4711; allowed: 1"):
        bank.require_own_devices()
    with ThreadPoolExecutor(1) as slow, pytest.raises(BadInput, match=r"amplifier\.serial"):
        asyncio.run(bank.activate(GainsActivateArgs(name=name), _no_loop, slow))
