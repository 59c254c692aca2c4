"""The script of a page that holds every row, as node runs it (conftest.py leaves this file out where there is none)."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest

from servod.lab.report.figures.motion import RecordedRun, recorded_run
from servod.lab.report.page_figure import _EVERY_ROW_JS, every_row_script


def test_what_comes_into_view_is_drawn_from_its_own_rows() -> None:
    t = np.arange(20_000) * 1e-3
    x = 0.1 * np.sin(40.0 * np.pi * t)
    figure = recorded_run(RecordedRun("run", t, {"position_rad": x, "reference_rad": 2.0 * x, "torque_nm": t}))
    script = """
    let moved = null;
    const drawn = [], element = { on: (_, act) => { moved = act; }, layout: { xaxis: { range: [3.0, 3.1] } } };
    const document = { getElementById: (id) => (id === "{plot_id}" ? null : element) };
    const Plotly = { restyle: (_, change, traces) => drawn.push([change, traces]) };
    """
    script += every_row_script(figure).replace("{plot_id}", "here")
    script += """
    moved({ "yaxis.range[0]": 1 });
    moved({ "xaxis2.range[0]": 3.0, "xaxis2.range[1]": 3.1 });
    moved({ "xaxis.autorange": true });
    console.log(JSON.stringify(drawn));
    """
    done = subprocess.run(["node", "-"], input=script, capture_output=True, text=True, check=True)
    near, far = json.loads(done.stdout)  # a change of the height alone draws nothing
    assert near[1] == far[1] == [0, 1, 2, 3]
    here = np.array(near[0]["x"][1])
    assert here[0] <= 3.0 and here[-1] >= 3.1 and len(here) < 110
    assert np.allclose(near[0]["y"][1], 0.1 * np.sin(40.0 * np.pi * here), atol=1e-6)
    assert max(map(len, far[0]["x"])) <= 4000 and far[0]["x"][1][-1] > 19.9


def test_from_afar_a_band_and_from_near_the_sine() -> None:
    script = (
        _EVERY_ROW_JS
        + """
    const x = Float64Array.from({ length: 60000 }, (_, k) => 1e-3 * k);
    const y = Float32Array.from(x, (t) => Math.sin(40 * Math.PI * t));
    y[31234] = 3.0;
    y[100] = NaN;
    const packed = Buffer.from(x.buffer).toString("base64");
    console.log(JSON.stringify({
      far: view(x, y, -Infinity, Infinity, 4000), near: view(x, y, 10.0, 10.1, 4000),
      same: unpacked(packed, Float64Array)[59999],
    }));
    """
    )
    done = subprocess.run(["node", "-"], input=script, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    far_x, far_y = (np.array(v, dtype=float) for v in found["far"])
    assert len(far_x) <= 4000 and np.all(np.diff(far_x) > 0)
    assert np.nanmax(far_y) == 3.0
    for second in range(60):
        part = far_y[(far_x >= second) & (far_x < second + 1)]
        assert np.nanmin(part) < -0.99 and np.nanmax(part) > 0.99
    near_x, near_y = (np.array(v) for v in found["near"])
    assert np.allclose(np.diff(near_x), 1e-3) and near_x[0] <= 10.0 and near_x[-1] >= 10.099
    assert np.allclose(near_y, np.sin(40.0 * np.pi * near_x), atol=1e-6)
    assert found["same"] == pytest.approx(59.999)
