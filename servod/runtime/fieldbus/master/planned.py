"""What a configuration plans, without a bus: the drivers' set-up faces, their PDOs, and the load that these will make.

Off the control path. `servod --check` and `servoctl config check` refuse by it what the bring-up would refuse later.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from servod.common.errors import BadInput
from servod.common.files import is_there
from servod.common.portable import has_group
from servod.formats.config import AxisConfig
from servod.formats.stopping import Stopping, with_stopping
from servod.runtime.fieldbus.cia import HEARTBEAT_BASE, SYNC_ID
from servod.runtime.fieldbus.devices import HANDSHAKE_SYNCS, Driver, NodePlan, PdoMap, Setup
from servod.runtime.fieldbus.registry import DRIVERS, driver_table, drivers_of, load_driver

# --- Bus load --------------------------------------------------------------------------------------------------------
# The bus load of an axis, computed from the mapping that will be written, before anything is started. Worst case: every
# frame with the most stuff bits its length allows. The items are kept apart, so that a refusal can say what uses the
# bus. Stands on servod.runtime.fieldbus.devices and servod.formats.config; the virtual bus models the same bits by its
# own code.


_INHIBIT_S = 100e-6


def worst_case_bits(data_bytes: int) -> int:
    """Bits of an 11-bit-identifier data frame with interframe space and the most stuff bits possible.

    8n + 47 + floor((33 + 8n) / 4): of the 47 + 8n bits, 34 + 8n are stuffed, after the first at most every fourth.
    """
    return 8 * data_bytes + 47 + (33 + 8 * data_bytes) // 4


@dataclass(frozen=True, slots=True)
class LoadItem:
    """One cyclic frame on the bus."""

    name: str
    can_id: int
    data_bytes: int
    frames_per_s: float

    @property
    def bits_per_s(self) -> float:
        """Bits that this frame takes per second, worst case."""
        return worst_case_bits(self.data_bytes) * self.frames_per_s


@dataclass(frozen=True, slots=True)
class BusLoad:
    """All cyclic frames of an axis on a bus of `bit_rate` bit/s."""

    bit_rate: int
    items: tuple[LoadItem, ...]

    @property
    def share(self) -> float:
        """Share of the bit rate, 0 to 1 and beyond."""
        return sum(item.bits_per_s for item in self.items) / self.bit_rate

    def describe(self) -> str:
        """The figures in one line, largest first."""
        largest_first = sorted(self.items, key=lambda item: -item.bits_per_s)
        parts = [
            f"{item.name} {worst_case_bits(item.data_bytes)} bit x {item.frames_per_s:g}/s = "
            f"{100.0 * item.bits_per_s / self.bit_rate:.1f} %"
            for item in largest_first
        ]
        return f"{100.0 * self.share:.1f} % of {self.bit_rate} bit/s ({', '.join(parts)})"


def pdo_rate_per_s(pdo: PdoMap, period_s: float) -> float:
    """Frames per second of a PDO: by SYNC, by its event timer, or, with neither, as its inhibit time allows."""
    if pdo.receive:
        return 1.0 / period_s  # the loop sends it every cycle, whatever its type
    if pdo.syncs:
        return 1.0 / (period_s * pdo.syncs)
    if pdo.event_timer_ms:
        return 1000.0 / pdo.event_timer_ms
    return 1.0 / max(period_s, pdo.inhibit_100us * _INHIBIT_S)


def bus_load(config: AxisConfig, plans: Iterable[NodePlan]) -> BusLoad:
    """The load of SYNC, all planned PDOs and the heartbeats of master and nodes."""
    period_s = config.cycle.period_us * 1e-6
    heartbeat = config.heartbeat
    master_id = HEARTBEAT_BASE + heartbeat.master_node_id
    items = [
        LoadItem("SYNC", SYNC_ID, 0, 1.0 / period_s),
        LoadItem("heartbeat of the master", master_id, 1, 1000.0 / heartbeat.master_period_ms),
    ]
    for plan in plans:
        node_rate = 1000.0 / heartbeat.node_period_ms
        items.append(LoadItem(f"heartbeat of node {plan.node_id}", HEARTBEAT_BASE + plan.node_id, 1, node_rate))
        for pdo in plan.pdos:
            name = f"node {plan.node_id} {'R' if pdo.receive else 'T'}PDO{pdo.number}"
            items.append(LoadItem(name, pdo.cob_id, pdo.data_bytes, pdo_rate_per_s(pdo, period_s)))
    return BusLoad(config.bus.bit_rate, tuple(items))


def check_bus_load(load: BusLoad, max_load: float) -> None:
    """Raise BadInput with all figures when the load exceeds the configured share."""
    if load.share > max_load:
        raise BadInput("bus load", load.describe(), f"at most bus.max_load = {100.0 * max_load:g} %")


#: What a Unix socket's path may be long (sockaddr_un.sun_path with its end, unix(7)).
SOCKET_PATH_BYTES = 107
_OWN_INTERFACES = ("socketcan", "virtual")

Kind = Literal["amplifier", "encoder"]


def load_setup(config: AxisConfig, kind: Kind) -> Setup:
    """The set-up face of the configured amplifier or encoder; raises BadInput unless it is a driver of that kind."""
    name = (config.amplifier if kind == "amplifier" else config.encoder).driver
    driver: Driver | None = load_driver(name) if name in DRIVERS or name in driver_table() else None
    if driver is None or driver.kind != kind:
        found = f"{name} ({driver.kind})" if driver else name
        raise BadInput(f"{kind}.driver", found, ", ".join(drivers_of(kind)))
    setup: Setup = driver.setup(config)
    return setup


def check_names(config: AxisConfig, source: str) -> list[str]:
    """Check what the configuration in the file `source` calls by name and no file stands for; gives notes for people.

    Raises BadInput for a bus interface that nobody knows, for a socket whose path the kernel does not take, and where a
    file stands in place of a folder. A control group that is missing is a note: the machine that checks need not be the
    one that runs.
    """
    check_interface(config.bus.interface, f"{source}: bus.interface")
    for key, folder in {"gains": config.gains.directory, "recorder": config.recorder.directory}.items():
        file = next((path for path in (folder, *folder.parents) if is_there(path)), folder)
        if is_there(file) and not file.is_dir():
            raise BadInput(
                f"{source}: {key}.directory", f"{file}, which is a file", "a folder; one that is missing is made"
            )
    paths = {"control.socket": str(config.control.socket)}
    if config.bus.interface == "virtual":
        paths["bus.channel"] = config.bus.channel
    for key, path in paths.items():
        length = len(os.fsencode(path))
        if length > SOCKET_PATH_BYTES:
            raise BadInput(f"{source}: {key}", f"{path} ({length} bytes)", f"at most {SOCKET_PATH_BYTES} bytes")
    if not has_group(config.control.group):
        return [
            f"this machine has no group {config.control.group} (control.group): only root and the daemon's user command"
        ]
    return []


def check_interface(interface: str, where: str) -> None:
    """Raise BadInput, with those that there are, for a bus interface that nobody knows."""
    if interface in _OWN_INTERFACES:
        return
    from can import VALID_INTERFACES

    if interface not in VALID_INTERFACES:
        names = ", ".join(sorted({*_OWN_INTERFACES, *VALID_INTERFACES}))
        raise BadInput(where, interface, names)


def reaction_s(config: AxisConfig, plan: NodePlan | None = None) -> float:
    """How long the drive goes on with its last command, in s: when the master is dead, until the deadline of its
    commands where it stops by that, else until its heartbeat consumer reacts; and when SYNC alone is lost, which none
    of both sees, until the loop has had no answer for long enough (servod.runtime.loop.axis). As planned, or as `plan`
    came up.
    """
    facts, heartbeat = (plan or load_setup(config, "amplifier").plan()).facts, config.heartbeat
    dead_ms = facts.get("reaction_ms")
    if dead_ms is None:
        by_deadline = facts.get("deadline_stops") and config.command_deadline_ms
        dead_ms = by_deadline or min(heartbeat.drive_timeout_ms, 2 * heartbeat.master_period_ms)
    unanswered_cycles = config.limits.stale_cycles + HANDSHAKE_SYNCS + 1
    return max(float(dead_ms) * 1e-3, unanswered_cycles * config.cycle.period_us * 1e-6)


def narrowed_by_stop(config: AxisConfig, plan: NodePlan | None = None) -> tuple[AxisConfig, Stopping | None]:
    """`config` with its limits narrowed by what the drive does by itself, and the statement (servod.formats.stopping);
    as planned, or as `plan` came up. Raises BadInput."""
    facts = (plan or load_setup(config, "amplifier").plan()).facts
    return with_stopping(config, reaction_s(config, plan), bool(facts.get("writes_ramp", True)))


def stopping_as_found(config: AxisConfig, plan: NodePlan) -> tuple[AxisConfig, Stopping | None]:
    """The limits and the stop of `config` (servod.formats.stopping) with the torque that the drive really leaves and
    the guards that it really has. Raises BadInput."""
    torque_nm = min(plan.facts.get("most_torque_nm", math.inf), config.limits.torque_nm)
    limits = config.limits.model_copy(update={"torque_nm": torque_nm})
    narrowed, stopping = narrowed_by_stop(config.model_copy(update={"limits": limits}), plan)
    # What is configured stays as it is: the test of the wiring compares it with the drive's rated torque.
    with_torque = narrowed.limits.model_copy(update={"torque_nm": config.limits.torque_nm})
    return narrowed.model_copy(update={"limits": with_torque}), stopping


def checked_load(config: AxisConfig, plans: list[NodePlan]) -> BusLoad:
    """The load that these plans make; raises BadInput with all figures when it exceeds `bus.max_load`."""
    load = bus_load(config, plans)
    check_bus_load(load, config.bus.max_load)
    return load


def planned_bus_load(config: AxisConfig, source: str) -> BusLoad:
    """The load that the configuration in the file `source` makes, computed without a bus.

    Raises BadInput, which names the file, for all that the bring-up would refuse before it asks the nodes.
    """
    try:
        return checked_load(config, [load_setup(config, kind).plan() for kind in ("amplifier", "encoder")])
    except BadInput as error:
        raise BadInput(f"{source}: {error.where}", error.found, error.allowed) from None
