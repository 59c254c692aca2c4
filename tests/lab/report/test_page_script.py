"""page.js as node runs it (conftest.py leaves this file out where there is none): what is drawn of the rows."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servod.lab.report.page import packed_series

SCRIPT = Path("servod/lab/report/page.js").resolve()


def node(script: str) -> Any:
    """What `script` prints as JSON, with the names of page.js at hand."""
    names = "const { loaded, view, ticks, extent, leftRoom, apart, wide } = require(" + json.dumps(str(SCRIPT)) + ");\n"
    done = subprocess.run(["node", "-"], input=names + script, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_rows_arrive_as_they_were_packed() -> None:
    t, jitter = 1e3 + 1e-3 * np.arange(5000), np.cumsum(np.random.default_rng(1).uniform(0.5e-3, 1.5e-3, 5000))
    y = 0.1 * np.sin(40.0 * np.pi * t)
    y[17] = np.nan
    packed = [packed_series(t, precise=True), packed_series(jitter, precise=True), packed_series(y)]
    assert packed[0] == {"n": 5000, "from": 1e3, "step": pytest.approx(1e-3)}  # an even grid needs no rows
    found = node(
        f"Promise.all({json.dumps(packed)}.map(loaded)).then((all) => console.log(JSON.stringify("
        "all.map((rows) => Array.from(rows)))));"
    )
    assert np.allclose(found[0], t, rtol=0.0, atol=1e-9)
    assert np.array_equal(found[1], jitter)
    assert found[2][17] is None
    found[2][17] = np.nan
    assert np.array_equal(np.array(found[2], dtype=np.float32), y.astype(np.float32), equal_nan=True)


def test_what_is_smooth_far_from_zero_has_no_steps() -> None:
    """A joint that creeps by a microradian a row, a thousand radians from its zero: four bytes hold every 60th row."""
    position = 1e3 + 1e-6 * np.arange(5000) ** 1.01
    found = node(
        f"loaded({json.dumps(packed_series(position))}).then((rows) => console.log(JSON.stringify(Array.from(rows))));"
    )
    assert np.array_equal(found, position)


def test_from_afar_a_band_and_from_near_the_sine() -> None:
    """A sine of 20 Hz at 1 kHz over a minute: no triangles, and no peak lost."""
    found = node("""
    const x = Float64Array.from({ length: 60000 }, (_, k) => 1e-3 * k);
    const y = Float32Array.from(x, (t) => Math.sin(40 * Math.PI * t));
    y[31234] = 3.0;
    y[100] = NaN;
    y[59999] = -2.0;
    console.log(JSON.stringify({ far: view(x, y, -Infinity, Infinity, 4000), near: view(x, y, 10.0, 10.2, 4000) }));
    """)
    far_x, far_y = (np.array(v, dtype=float) for v in found["far"])
    assert len(far_x) <= 4000 and np.all(np.diff(far_x) > 0)
    assert np.nanmax(far_y) == 3.0 and np.isnan(far_y).any() and (far_x[0], far_y[-1]) == (0.0, -2.0)
    for second in range(60):
        part = far_y[(far_x >= second) & (far_x < second + 1)]
        assert np.nanmin(part) < -0.99 and np.nanmax(part) > 0.99
    near_x, near_y = (np.array(v) for v in found["near"])
    assert np.allclose(np.diff(near_x), 1e-3) and near_x[0] <= 10.0 and near_x[-1] >= 10.199
    assert np.allclose(near_y, np.sin(40.0 * np.pi * near_x), atol=1e-6)


@pytest.mark.parametrize(
    ("scale", "ends", "words", "factor"),
    [
        ({}, (0.0, 60.0), ["0", "10", "20", "30", "40", "50", "60"], ""),
        ({}, (-0.1, 0.1), ["−0.10", "−0.05", "0.00", "0.05", "0.10"], ""),
        ({}, (0.0, 4e-6), ["0", "1", "2", "3", "4"], " ×10⁻⁶"),
        ({"log": True}, (-1.0, 3.0), ["0.1", "1", "10", "100", "1000"], ""),
        ({"log": True}, (-6.0, -4.0), ["10⁻⁶", "10⁻⁵", "10⁻⁴"], ""),
        ({"names": ["OFF", "ON"]}, (-0.5, 1.5), ["OFF", "ON"], ""),
    ],
)
def test_ticks_are_round_numbers_with_as_few_digits_as_tell_them_apart(
    scale: dict[str, Any], ends: tuple[float, float], words: list[str], factor: str
) -> None:
    found = node(
        f"const t = ticks({json.dumps(scale)}, {ends[0]}, {ends[1]}, 6);"
        "console.log(JSON.stringify([t.at.map((v) => t.words(v)), t.factor]));"
    )
    assert found == [words, factor]


def test_what_is_infinite_has_no_part_in_a_scale() -> None:
    """One such sample would leave a picture empty."""
    found = node("console.log(JSON.stringify(extent([[1, 2, Infinity], [NaN, -3, -Infinity]])));")
    assert found == [-3, 2]


@pytest.mark.parametrize("ends", [(-1.2e-3, 0.2e-3), (-2e4, -1.9999e4), (-1e-4, 1e-4), (0.0, 1.0)])
def test_words_of_ticks_have_the_room_that_they_take(ends: tuple[float, float]) -> None:
    """The minus sign among them; and those of a scale that lies do not stand upon one another."""
    low, high = ends
    found = node(f"""
    const y = ticks({{}}, {low}, {high}, 6), x = apart({{}}, {low}, {high}, 250);
    const words = (t) => t.at.map((v) => wide(t.words(v)));
    console.log(JSON.stringify([leftRoom(y), words(y), words(x), x.at]));
    """)
    left, upright, lying, places = found
    assert left >= max(50, max(upright) + 6)
    assert len(places) >= 2
    between = (places[1] - places[0]) / (high - low) * 250
    assert len(places) < 3 or between >= max(lying)
