"""`servoctl preset`: sets the joint's zero in the encoder (CiA 406, 0x6003), on the bus itself, without a daemon."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servod.cli.common import JsonOption, example, report
from servod.common.portable import need_linux

_HELP = example(
    "Make the joint's present position read --position-rad in the encoder. Only while no daemon runs the axis, the "
    "drive has no power and the joint stands: every position changes by it.",
    "servoctl preset /etc/servod/axis.yaml --position-rad 0",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("preset", help=_HELP)(preset)


def preset(
    config: Annotated[Path, typer.Argument(help="Configuration of the axis.")],
    position_rad: Annotated[float, typer.Option(help="What the present position shall read, in rad.")],
    as_json: JsonOption = False,
) -> None:
    """Set the encoder's zero."""
    need_linux("servoctl preset")
    from contextlib import closing

    from servod.common.clock import WallClock
    from servod.formats.config import load_config
    from servod.runtime.daemon.lock import InstanceLock
    from servod.runtime.fieldbus.bus.open import open_bus
    from servod.runtime.fieldbus.master import Master
    from servod.runtime.fieldbus.master.planned import check_interface

    axis = load_config(config)
    check_interface(axis.bus.interface, f"{config}: bus.interface")
    lock = InstanceLock(axis, passing=True)
    try:
        with closing(Master(axis, open_bus(axis.bus), WallClock(), threaded=False)) as master:
            counts, reads_rad = master.preset_encoder(position_rad)
    finally:
        lock.release()
    node_id = axis.encoder.node_id
    done = f"encoder node {node_id} reads {reads_rad:g} rad here (0x6003 = {counts})"
    low_rad, high_rad = axis.limits.position_min_rad, axis.limits.position_max_rad
    if not low_rad <= reads_rad <= high_rad:
        done += f"; that is outside the limits ({low_rad:g} to {high_rad:g} rad), where the axis is not enabled"
    report({"node_id": node_id, "position_rad": reads_rad, "counts": counts}, done, as_json)
