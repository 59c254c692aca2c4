import socket
import urllib.request
from pathlib import Path

import pytest
from daemon_rows import record
from prometheus_client.parser import text_string_to_metric_families

from servod.common.errors import BadInput
from servod.common.faults import FaultCode
from servod.formats.config import MetricsConfig
from servod.runtime.daemon.metrics import AxisMetrics, MetricsServer
from servod.runtime.loop.axis_state import AxisState

CLIP = 1 << FaultCode.TORQUE_CLIPPED


def _values(text: str) -> dict[tuple[str, str], float]:
    """Value of each sample by name and its one label's value."""
    families = text_string_to_metric_families(text)
    return {(s.name, next(iter(s.labels.values()), "")): s.value for family in families for s in family.samples}


def _filled() -> AxisMetrics:
    metrics = AxisMetrics("axis", 0.42)
    lags_us = [5, 60, 60, 600, 30_000]
    metrics.count([record(n, lag_ns=lag * 1000, missed=3, bus_error_frames=7) for n, lag in enumerate(lags_us)])
    metrics.count(
        [record(n, lag_ns=1000, encoder_age=n, faults=CLIP * (n % 2), axis_state=AxisState.ENABLED) for n in range(4)]
    )
    return metrics


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_textfile_has_histograms_counters_and_states(tmp_path: Path) -> None:
    path = tmp_path / "below" / "axis.prom"
    MetricsServer(MetricsConfig(textfile=path), _filled()).write_textfile()
    values = _values(path.read_text())
    assert values["servod_wakeup_lag_seconds_bucket", "1e-05"] == 5  # 5 us and four times 1 us
    assert values["servod_wakeup_lag_seconds_bucket", "7.5e-05"] == 7
    assert values["servod_wakeup_lag_seconds_bucket", "+Inf"] == 9
    assert values["servod_wakeup_lag_seconds_sum", ""] == pytest.approx(30_729e-6)
    assert values["servod_faults_total", "TORQUE_CLIPPED"] == 2
    assert values["servod_axis_state", "enabled"] == 1
    assert values["servod_axis_state", "disabled"] == 0
    assert values["servod_feedback_age_cycles", "encoder"] == 3  # the position below is so old
    assert values["servod_feedback_age_cycles", "amplifier"] == 0
    assert values["servod_bus_load_ratio", ""] == 0.42
    assert [f.name for f in path.parent.iterdir()] == ["axis.prom"]


def test_http_serves_the_same_registry_locally() -> None:
    port = _free_port()
    server = MetricsServer(MetricsConfig(http_port=port), _filled())
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
        values = _values(answer.read().decode())
    assert values["servod_cycles_total", ""] == 3
    with pytest.raises(BadInput, match=r"metrics\.http_port"):
        MetricsServer(MetricsConfig(http_port=port), _filled())
    server.close()


def test_before_the_first_cycle_there_is_no_state() -> None:
    names = {family.name for family in AxisMetrics("axis", 0.1).collect()}
    assert "servod_wakeup_lag_seconds" in names
    assert "servod_axis_state" not in names
