"""What the axis is doing, in one word: beside the axis, for all who look at it (record, status, verbs)."""

from __future__ import annotations

from enum import IntEnum


class AxisState(IntEnum):
    """What the axis is doing, for people and for the record."""

    DISABLED = 0
    ENABLING = 1
    ENABLED = 2
    BRAKING = 3  # controller still active, reference slowing down
    RAMPING = 4  # torque going to zero
    QUICK_STOPPING = 5  # the drive stops the axis
    FAULT = 6
    PROVING = 7  # before the first torque: the bounded test of the wiring (servod.runtime.loop.wiring.wiring_test)
    RELEASING = 8  # the controller holds the joint while the brake opens
    ENGAGING = 9  # the controller holds the joint while the brake closes

    @property
    def stopped(self) -> bool:
        """Nothing is commanded; what asks for a standing axis may begin."""
        return self in (AxisState.DISABLED, AxisState.FAULT)

    @property
    def starting(self) -> bool:
        """Nothing is moved under control yet: whatever ends these states switches off at once."""
        return self in (AxisState.ENABLING, AxisState.PROVING)

    @property
    def arriving(self) -> bool:
        """On the way to ENABLED."""
        return self.starting or self is AxisState.RELEASING

    @property
    def under_way(self) -> bool:
        """On the way to ENABLED, or there."""
        return self.arriving or self is AxisState.ENABLED

    @property
    def controlled(self) -> bool:
        """The controller has the torque, or had it and its torque goes to zero."""
        return self in _CONTROLLED

    @property
    def following(self) -> bool:
        """The joint is to follow a reference."""
        return self in _FOLLOWING

    @property
    def powered(self) -> bool:
        """The loop commands torque: under control, or in the test of the wiring."""
        return self in _CONTROLLED or self is AxisState.PROVING


_FOLLOWING = (AxisState.ENABLED, AxisState.BRAKING, AxisState.RELEASING, AxisState.ENGAGING)
_CONTROLLED = (*_FOLLOWING, AxisState.RAMPING)
