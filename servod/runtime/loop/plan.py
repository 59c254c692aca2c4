"""What the loop process is given at its start: configuration, node plans and the first controller, as one JSON text."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from servod.formats.config import AxisConfig
from servod.kernels.stopping import StopFacts
from servod.runtime.fieldbus.devices import NodePlan, PdoEntry, PdoMap


@dataclass(frozen=True)
class LoopPlan:
    """Everything the loop needs; `law` and `parameters` are a packed gain set (servod.formats.gains.gain_set),
    `serial` its number; `stop` what the limits reckon a stop with, None where nothing is known of the joint; `carried`
    the faults of a loop before, which nobody has acknowledged."""

    config: AxisConfig
    amplifier: NodePlan
    encoder: NodePlan
    law: int
    parameters: tuple[float, ...]
    serial: int = 0
    stop: StopFacts | None = None
    carried: int = 0

    def to_json(self) -> str:
        """The plan as text for the loop process."""
        return json.dumps(
            {
                "config": self.config.model_dump(mode="json"),
                "amplifier": asdict(self.amplifier),
                "encoder": asdict(self.encoder),
                "law": self.law,
                "parameters": list(self.parameters),
                "serial": self.serial,
                "stop": self.stop,
                "carried": self.carried,
            }
        )

    @classmethod
    def from_json(cls, text: str) -> LoopPlan:
        """The plan that `to_json` wrote."""
        data = json.loads(text)
        return cls(
            AxisConfig.model_validate(data["config"]),
            _node_plan(data["amplifier"]),
            _node_plan(data["encoder"]),
            data["law"],
            tuple(data["parameters"]),
            data["serial"],
            None if data["stop"] is None else StopFacts(*data["stop"]),
            data["carried"],
        )


def _node_plan(data: dict[str, Any]) -> NodePlan:
    return NodePlan(data["driver"], data["node_id"], tuple(map(_pdo_map, data["pdos"])), data["facts"])


def _pdo_map(data: dict[str, Any]) -> PdoMap:
    entries: Sequence[dict[str, int]] = data["entries"]
    return PdoMap(**{**data, "entries": tuple(PdoEntry(**e) for e in entries)})
