"""How far the joint has moved over the last cycles: what tells motion, its direction and rest from single counts.

Used by the test of the wiring in the loop; a fixed number of floats, nothing grows.
"""

from __future__ import annotations

#: Cycles over which rest is judged, and over which speed and direction are.
REST_CYCLES, SPEED_CYCLES = 20, 5

#: A way shorter than this share of the one before it: the joint slows down.
_SLOWER = 0.9


class Sway:
    """The last REST_CYCLES positions with their times."""

    def __init__(self, position_rad: float, time_s: float) -> None:
        self._positions = [position_rad] * (REST_CYCLES + 1)
        self._times = [time_s] * (REST_CYCLES + 1)
        self._at = 0
        self.count = 0  # cycles seen
        self._steps_rad = 0.0  # sum of the differences between neighbours

    def add(self, position_rad: float, time_s: float) -> None:
        """One cycle."""
        self._steps_rad += abs(position_rad - self._positions[self._at])
        self._at = (self._at + 1) % (REST_CYCLES + 1)
        oldest = self._at
        if self.count >= REST_CYCLES:
            following = (oldest + 1) % (REST_CYCLES + 1)
            self._steps_rad -= abs(self._positions[following] - self._positions[oldest])
        self._positions[oldest], self._times[oldest] = position_rad, time_s
        self.count += 1

    def way_rad(self, cycles: int) -> float:
        """From `cycles` ago to now, with its sign."""
        return self._positions[self._at] - self._positions[self._at - cycles]

    def speed_rad_s(self) -> float:
        """Mean over the last SPEED_CYCLES, with its sign; 0 before there are so many."""
        passed_s = self._times[self._at] - self._times[self._at - SPEED_CYCLES]
        return self.way_rad(SPEED_CYCLES) / passed_s if passed_s > 0.0 else 0.0

    def mean_rad(self) -> float:
        """Mean position of a joint that stands, without the sensor's noise; of one that moves, where it is."""
        mean = sum(self._positions) / (REST_CYCLES + 1)
        return mean if abs(self.way_rad(REST_CYCLES)) <= 4.0 * self.step_rad() else self._positions[self._at]

    def slows(self) -> bool:
        """The last SPEED_CYCLES brought a shorter way than those before them."""
        before = self._positions[self._at - SPEED_CYCLES] - self._positions[self._at - 2 * SPEED_CYCLES]
        return abs(self.way_rad(SPEED_CYCLES)) < _SLOWER * abs(before)

    def step_rad(self) -> float:
        """Mean difference between neighbours over REST_CYCLES: at rest, the sensor's noise."""
        return max(0.0, self._steps_rad) / REST_CYCLES
