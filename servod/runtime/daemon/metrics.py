"""Prometheus metrics of one axis: distributions of the loop's timing, counters, states.

Beside the loop, fed by the supervisor with what it drained. Counting is a bisect and an addition per value; names and
labels are made only when somebody collects. Served over a local HTTP port, written as a textfile, or both.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from prometheus_client import CollectorRegistry, start_http_server, write_to_textfile
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from servod.common.errors import BadInput
from servod.common.faults import FAULTS, FaultCode
from servod.common.files import reason
from servod.formats.config import MetricsConfig
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.promise import QuantityStatus
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState

#: Upper bounds of the histograms' buckets, in ns: from a good wake-up to several lost periods.
_BOUNDS_NS = tuple(n * 1000 for n in (10, 20, 50, 75, 100, 150, 200, 300, 500, 750, 1000, 2000, 5000, 20_000))


class _Histogram:
    """Counts of one distribution; `add` is cheap."""

    __slots__ = ("counts", "sum_ns")

    def __init__(self) -> None:
        self.counts = [0] * (len(_BOUNDS_NS) + 1)
        self.sum_ns = 0

    def add(self, value_ns: int) -> None:
        """Count one value."""
        self.counts[bisect_left(_BOUNDS_NS, value_ns)] += 1
        self.sum_ns += value_ns

    def family(self, name: str, text: str) -> HistogramMetricFamily:
        """The distribution as Prometheus wants it: cumulative, in seconds."""
        total, buckets = 0, []
        for bound, count in zip((*(f"{b / 1e9:g}" for b in _BOUNDS_NS), "+Inf"), self.counts, strict=True):
            total += count
            buckets.append((bound, float(total)))
        return HistogramMetricFamily(name, text, buckets=buckets, sum_value=self.sum_ns / 1e9)


class AxisMetrics(Collector):
    """All metrics of one axis; `count` per drained record, `collect` for Prometheus."""

    def __init__(self, axis_name: str, bus_load: float) -> None:
        self._name, self._bus_load = axis_name, bus_load
        self._lag, self._tick, self._torque = _Histogram(), _Histogram(), _Histogram()
        self._latest: CycleRecord | None = None
        self._faults = dict.fromkeys(FaultCode, 0)
        self._before = 0
        self.records_lost = 0
        self.joint: Callable[[], Sequence[QuantityStatus]] = tuple
        self.registry = CollectorRegistry()
        self.registry.register(self)

    def count(self, records: Iterable[CycleRecord]) -> None:
        """Take drained records, oldest first."""
        lag, tick, torque, before = self._lag.add, self._tick.add, self._torque.add, self._before
        for record in records:
            lag(record.lag_ns)
            tick(record.tick_ns)
            torque(record.torque_sent_ns)
            if record.faults != before:
                self._count_faults(record.faults & ~before)
                before = record.faults
            self._latest = record
        self._before = before

    def count_fault(self, code: FaultCode) -> None:
        """Count a fault that the supervisor found itself."""
        self._faults[code] += 1

    def _count_faults(self, appeared: int) -> None:
        for code, fault in FAULTS.items():
            if appeared & fault.bit:
                self._faults[code] += 1

    def collect(self) -> Iterator[Metric]:
        """The metric families; called by prometheus-client."""
        yield self._lag.family("servod_wakeup_lag_seconds", "Wake-up of the loop after the cycle's deadline")
        yield self._tick.family("servod_tick_seconds", "Work of one cycle without waiting")
        yield self._torque.family("servod_torque_latency_seconds", "Cycle's deadline to the torque frame")
        faults = CounterMetricFamily("servod_faults", "Faults and limits that were hit, by name", labels=["fault"])
        for code, count in self._faults.items():
            faults.add_metric([code.name], count)
        yield faults
        yield GaugeMetricFamily("servod_bus_load_ratio", "Cyclic share of the bit rate, computed", self._bus_load)
        yield CounterMetricFamily("servod_records_lost", "Cycle records overwritten before read", self.records_lost)
        shares = GaugeMetricFamily(
            "servod_joint_share", "Value of the joint over that of the certified model", labels=["of"]
        )
        errors = GaugeMetricFamily(
            "servod_joint_share_standard_error", "What servod_joint_share may be off by", labels=["of"]
        )
        for row in self.joint():
            for family, value in ((shares, row["share"]), (errors, row["standard_error"])):
                family.add_metric([row["name"].replace(" ", "_")], value)
        yield from (shares, errors)
        if self._latest is not None:
            yield from self._of_latest(self._latest)

    def _of_latest(self, record: CycleRecord) -> Iterator[Metric]:
        yield CounterMetricFamily("servod_cycles", "Cycles since the start, skipped ones included", record.cycle)
        yield CounterMetricFamily("servod_missed_cycles", "Periods skipped since the start", record.missed)
        yield CounterMetricFamily("servod_bus_queue_full", "Frames that could not be queued", record.bus_queue_full)
        yield CounterMetricFamily("servod_bus_error_frames", "Error frames seen", record.bus_error_frames)
        yield CounterMetricFamily("servod_bus_late_frames", "Feedback that came after its cycle", record.late_frames)
        yield CounterMetricFamily("servod_bus_ignored_frames", "Frames that fit no mapping", record.ignored_frames)
        yield _state("servod_axis_state", "1 for the state of the axis", AxisState(record.axis_state), AxisState)
        yield _state("servod_drive_state", "1 for the drive's state", DriveState(record.drive_state), DriveState)
        ages = GaugeMetricFamily("servod_feedback_age_cycles", "Cycles since the device's last feedback", labels=["of"])
        ages.add_metric(["amplifier"], float(record.amplifier_age))
        ages.add_metric(["encoder"], float(record.encoder_age))
        yield ages
        yield GaugeMetricFamily("servod_position_radians", "Joint position", record.position_rad)
        yield GaugeMetricFamily("servod_torque_newton_metres", "Commanded torque after limits", record.torque_nm)


def _state(
    name: str, text: str, now: AxisState | DriveState, states: type[AxisState] | type[DriveState]
) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, text, labels=["state"])
    for state in states:
        family.add_metric([state.name.lower()], float(state == now))
    return family


class MetricsServer:
    """Hands the metrics out as configured: HTTP in a thread of prometheus-client's, textfile on `write_textfile`."""

    def __init__(self, config: MetricsConfig, metrics: AxisMetrics) -> None:
        """Raises BadInput when the port cannot be opened."""
        self._metrics, self._textfile = metrics, config.textfile
        self._server = None
        if config.http_port is not None:
            try:
                self._server, self._thread = start_http_server(config.http_port, config.http_address, metrics.registry)
            except OSError as error:
                where = f"metrics.http_port: {config.http_address}:{config.http_port}"
                raise BadInput(where, reason(error), "a free local port") from None

    def write_textfile(self) -> None:
        """Replace the textfile, if one is configured. Raises OSError."""
        if self._textfile is not None:
            Path(self._textfile).parent.mkdir(parents=True, exist_ok=True)
            write_to_textfile(str(self._textfile), self._metrics.registry)

    def close(self) -> None:
        """Stop serving."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join(1.0)
