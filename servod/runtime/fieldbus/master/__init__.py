"""CANopen master: set-up, supervision and scan of the nodes, off the control path; canopen on a servod Bus."""

from __future__ import annotations

from servod.runtime.fieldbus.master.master import BringUp, Master, master_ids
from servod.runtime.fieldbus.master.monitor import NodeEvent
from servod.runtime.fieldbus.master.start_watch import start_ids

__all__ = ["BringUp", "Master", "NodeEvent", "master_ids", "start_ids"]
