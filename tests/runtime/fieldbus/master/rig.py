"""Master and both drivers on the stepped virtual axis: real nodes, real frames, virtual time, one process."""

from __future__ import annotations

from typing import Any

from witness import axis_config

from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import SteppedWorld
from servod.formats.model.axis_model import AxisModel
from servod.runtime.fieldbus.bus import Frame
from servod.runtime.fieldbus.cia import HEARTBEAT_BASE, SYNC_ID
from servod.runtime.fieldbus.devices import AmplifierCommand, AmplifierFeedback, EncoderFeedback, Goal
from servod.runtime.fieldbus.master import Master, NodeEvent
from servod.runtime.fieldbus.registry import load_driver

JOINT = {"inertia": 0.001, "friction": {"kind": "coulomb_viscous", "coulomb": 0.01, "viscous": 0.05}}
PERIOD_NS = 1_000_000
FEEDBACK_WINDOW_NS = 600_000
SYNCHRONOUS_IDS = (0x181, 0x282)


def stepped_world(**settings: Any) -> SteppedWorld:
    """A virtual axis with a light joint."""
    return SteppedWorld(VirtualAxisSettings.model_validate(settings), AxisModel.model_validate(JOINT))


class Rig:
    """What the loop does each cycle, in its plainest form, with the master beside it."""

    def __init__(self, world: SteppedWorld | None = None, **sections: Any) -> None:
        self.world = stepped_world() if world is None else world
        self.config = axis_config(**sections)
        self.clock = self.world.clock
        self.master = Master(self.config, self.world.connect(), self.clock, threaded=False)
        self.bus = self.world.connect()
        self.heartbeat = True
        self.events: list[NodeEvent] = []

    def start(self) -> None:
        """Bring up, build the cycle faces, and begin to cycle at the next full millisecond."""
        self.up = self.master.bring_up()
        self.amplifier = load_driver("cia402").cyclic(self.up.amplifier)
        self.encoder = load_driver("cia406").cyclic(self.up.encoder)
        self.cycles = 0
        self.deadline_ns = self.clock.now_ns()

    def cycle(self, goal: Goal, torque_nm: float = 0.0, **flags: Any) -> tuple[AmplifierFeedback, EncoderFeedback]:
        """One cycle: heartbeat, SYNC, feedback, command."""
        self.deadline_ns += PERIOD_NS
        self.clock.sleep_until(self.deadline_ns)
        while (frame := self.bus.receive(0.0)) is not None:
            if frame.can_id not in SYNCHRONOUS_IDS:  # feedback of the last SYNC would pass for this one's
                self._hand_over(frame)
        if self.heartbeat and self.cycles % 50 == 0:
            self.bus.send(HEARTBEAT_BASE + self.config.heartbeat.master_node_id, b"\x05")
        self.bus.send(SYNC_ID, b"")
        self.cycles += 1
        feedback = self._feedback()
        self.bus.send(*self.amplifier.write(AmplifierCommand(goal, torque_nm, **flags)))
        self.master.poll()
        self.events += self.master.events()
        return feedback

    def _feedback(self) -> tuple[AmplifierFeedback, EncoderFeedback]:
        waiting = self.amplifier.sync_frames + self.encoder.sync_frames
        end_ns = self.clock.now_ns() + FEEDBACK_WINDOW_NS
        while waiting and (remaining_ns := end_ns - self.clock.now_ns()) > 0:
            frame = self.bus.receive(remaining_ns * 1e-9)
            if frame is None:
                break
            waiting -= self._hand_over(frame)
        return self.amplifier.read(), self.encoder.read()

    def _hand_over(self, frame: Frame) -> bool:
        devices = (self.amplifier, self.encoder)
        return any(device.on_frame(*frame) for device in devices if frame.can_id in device.receive_ids)

    def run(self, cycles: int, goal: Goal, torque_nm: float = 0.0) -> tuple[AmplifierFeedback, EncoderFeedback]:
        """Several cycles; the last feedback."""
        for _ in range(cycles):
            feedback = self.cycle(goal, torque_nm)
        return feedback

    def until(self, goal: Goal, limit: int = 400, torque_nm: float = 0.0) -> AmplifierFeedback:
        """Cycle until the goal is reached; fails with the reasons otherwise."""
        self.cycle(goal, torque_nm)  # what is read before the first write of a goal still judges the last one
        for _ in range(limit):
            feedback, _ = self.cycle(goal, torque_nm)
            if feedback.goal_reached:
                return feedback
        raise AssertionError(f"{goal!r} not reached: {feedback}")
