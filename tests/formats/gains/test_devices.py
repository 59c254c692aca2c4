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
from servod.formats.gains.store import GainStore
from servod.formats.model.identified import Devices
from servod.runtime.daemon.arguments import GainsActivateArgs, GainsVerdictArgs
from servod.runtime.daemon.gain_bank import Fits, GainBank
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


class _Loop:
    """Takes every order, and keeps them."""

    def __init__(self) -> None:
        self.sent: list[Op] = []

    async def send(self, op: Op, _arguments: Sequence[float]) -> Any:
        self.sent.append(op)


def _bank(
    folder: Path, initial: GainSet, *, accept: bool = False, fits: Fits = lambda _gains, _config: None
) -> GainBank:
    """A bank that minds nothing but devices."""
    file = folder / "initial.yaml"
    file.write_text(initial.to_yaml())
    config = configured(accept)
    gains = config.gains.model_copy(update={"directory": folder / "store", "initial": file})
    return GainBank(config.model_copy(update={"gains": gains}), fits)


def _of_own() -> GainSet:
    return identified_with(OWN).model_copy(update={"certificate": None}).sealed()


OTHERS = Devices.model_validate(OWN | {"amplifier": {"serial": 1}})
SAID = r"amplifier\.serial: found 4711; allowed: 1"


def test_an_axis_that_found_other_devices_runs_no_set_of_these(tmp_path: Path) -> None:
    """Neither the one it starts with nor one that is activated or gone back to, whatever else fits."""
    bank, loop = _bank(tmp_path, _of_own()), _Loop()
    bank.require_own_devices()  # nobody has asked the nodes yet
    bank.know(Devices.model_validate(OWN))
    bank.require_own_devices()
    assert bank.describe(0)["note"] == ""
    bank.know(OTHERS)
    assert "the axis is not enabled: " in bank.describe(0)["note"]
    with pytest.raises(BadInput, match=SAID):
        bank.require_own_devices()
    with ThreadPoolExecutor(1) as slow, pytest.raises(BadInput, match=SAID):
        asyncio.run(bank.activate(GainsActivateArgs(name=bank.newest.name), loop.send, slow))
    assert loop.sent == []


def test_a_set_on_trial_that_ends_before_one_of_other_devices_ends_on_an_axis_that_is_off(tmp_path: Path) -> None:
    bank, loop = _bank(tmp_path, _of_own()), _Loop()
    GainStore(tmp_path / "store").load_file(shipped("gains/demo_pd.yaml"))
    bank.know(OTHERS)
    with ThreadPoolExecutor(1) as slow:
        asyncio.run(bank.activate(GainsActivateArgs(name="demo_pd", trial=True), loop.send, slow))
        bank.require_own_devices()
        asyncio.run(bank.rollback(GainsVerdictArgs(trial=True), loop.send, slow))
    assert loop.sent == [Op.ACTIVATE, Op.QUICK_STOP, Op.ACTIVATE] and not bank.on_trial
    with pytest.raises(BadInput, match=SAID):
        bank.require_own_devices()


def test_a_set_of_other_devices_that_was_active_gives_way_to_the_initial_one(tmp_path: Path) -> None:
    pd = load_gains(shipped("gains/demo_pd.yaml"))
    store = GainStore(tmp_path / "store")
    stored = store.load(_of_own().to_yaml(), "own")
    store.activate(stored.name, stored.version, "")
    bank = _bank(tmp_path, pd)
    assert bank.newest.name == stored.name
    bank.know(OTHERS)
    assert bank.newest.name == pd.name
    assert f"{pd.name} version 1 (gains.initial) runs in its place" in bank.describe(0)["note"]
    bank.require_own_devices()


def test_where_any_set_is_accepted_one_of_other_devices_runs_and_is_told_of(tmp_path: Path) -> None:
    bank = _bank(tmp_path, _of_own(), accept=True)
    bank.know(OTHERS)
    bank.require_own_devices()
    assert "gains.accept_uncertified lets a set of other devices run" in bank.describe(0)["note"]


def test_an_initial_set_that_may_not_run_does_not_run_in_place_of_one_of_other_devices(tmp_path: Path) -> None:
    store = GainStore(tmp_path / "store")
    stored = store.load(_of_own().to_yaml(), "own")
    store.activate(stored.name, stored.version, "")

    def fits(gains: GainSet, _config: AxisConfig) -> None:
        if gains.name != stored.name:
            raise BadInput("initial.yaml", "no certificate", "one")

    bank = _bank(tmp_path, load_gains(shipped("gains/demo_pd.yaml")), fits=fits)
    bank.know(OTHERS)
    assert bank.newest.name == stored.name and "the axis is not enabled" in bank.describe(0)["note"]
    with pytest.raises(BadInput, match=SAID):
        bank.require_own_devices()
