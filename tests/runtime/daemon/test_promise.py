"""A joint that is not as certified any more is told within seconds of motion; a sound one never.

The plants are those of the virtual axis under the set that ships; sums and solution have a second implementation here.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from servod.cli.app import run
from servod.client.axis import ReferenceMotion
from servod.client.open import daemon_axis, stepped_axis
from servod.common.shipped import shipped
from servod.common.yaml import validate
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.formats.recording.record import RECORD, CycleRecord
from servod.runtime.daemon.promise import BACKWARD, FORWARD, INERTIA, Expected, PromiseWatch, Shares

FRICTION = ("coulomb", "static", "viscous", "sigma0", "sigma1")
JOINT = load_axis_model(shipped("gains/axes/demo_joint.yaml"))
SLOW, MIDDLE, BRISK = (ReferenceMotion.sine(a, hz, 10.0) for a, hz in ((0.05, 0.5), (0.02, 2.0), (0.01, 6.0)))
PAPER = ReferenceMotion({"kind": "paper", "duration_s": 10.0})


@pytest.fixture(scope="module")
def certified() -> GainSet:
    return load_gains(shipped("gains/demo_local_certified.yaml"))


def joint(friction: float = 1.0, inertia: float = 1.0, **over: Any) -> AxisModel:
    """The demo joint, changed."""
    data = JOINT.model_dump(mode="json", exclude_none=True) | over
    data["friction"] |= {key: friction * data["friction"][key] for key in FRICTION}
    data["inertia"] *= inertia
    return validate(data, AxisModel, "joint")


def moved(plant: AxisModel, gains: GainSet, folder: Path, motion: ReferenceMotion) -> list[CycleRecord]:
    with stepped_axis(plant, gains, folder, 3) as axis:
        return [CycleRecord._make(row) for row in RECORD.iter_unpack(axis.run(motion))]


def watched(gains: GainSet, records: list[CycleRecord]) -> tuple[PromiseWatch, list[tuple[float, str]]]:
    """What is told, with the time since the motion's begin."""
    watch = PromiseWatch()
    watch.begin(records[-1].controller, Expected.of(gains))
    told = [((r.time_ns - records[0].time_ns) * 1e-9, text) for r in records for text in watch.see([r])]
    return watch, told


@pytest.mark.parametrize("motion", [SLOW, MIDDLE, BRISK, PAPER], ids=["slow", "middle", "brisk", "paper"])
def test_a_sound_joint_is_let_alone(certified: GainSet, tmp_path: Path, motion: ReferenceMotion) -> None:
    watch, told = watched(certified, moved(JOINT, certified, tmp_path, motion))
    assert told == []
    assert watch.motion_s > 5.0
    for row in watch.status()["joint"]:
        assert abs(row["share"] - 1.0) < max(0.06, 3.0 * row["standard_error"])


@pytest.mark.parametrize("share", [0.6, 1.5])
@pytest.mark.parametrize("motion", [SLOW, BRISK], ids=["slow", "brisk"])
def test_friction_that_changed_is_named(
    certified: GainSet, tmp_path: Path, motion: ReferenceMotion, share: float
) -> None:
    watch, told = watched(certified, moved(joint(friction=share), certified, tmp_path, motion))
    named = {name for name in (INERTIA, FORWARD, BACKWARD) if any(name in text for _, text in told)}
    assert named == {FORWARD, BACKWARD}
    assert all(time_s < 10.0 for time_s, _ in told)
    for row in watch.status()["joint"][1:]:
        assert row["share"] == pytest.approx(share, abs=0.06) and row["told"]


@pytest.mark.parametrize("motion", [MIDDLE, BRISK], ids=["middle", "brisk"])
def test_inertia_that_changed_is_named(certified: GainSet, tmp_path: Path, motion: ReferenceMotion) -> None:
    watch, told = watched(certified, moved(joint(inertia=2.0), certified, tmp_path, motion))
    assert [INERTIA in text for _, text in told] == [True]
    assert told[0][0] < 10.0
    row = watch.status()["joint"][0]
    assert row["share"] == pytest.approx(2.0, abs=max(0.15, 2.0 * row["standard_error"]))
    assert row["standard_error"] < 0.2


def test_a_slow_motion_does_not_tell_of_the_inertia_and_says_so(certified: GainSet, tmp_path: Path) -> None:
    watch, told = watched(certified, moved(joint(inertia=2.0), certified, tmp_path, PAPER))
    assert told == []
    assert watch.status()["joint"][0]["standard_error"] > 0.2


def test_an_error_beyond_the_promise_is_told_once(certified: GainSet, tmp_path: Path) -> None:
    """The same motion of a sound joint, and an encoder that shows it a share of a milliradian off."""
    records = moved(JOINT, certified, tmp_path, SLOW)
    _, sound = watched(certified, records)
    _, told = watched(certified, [r._replace(position_rad=r.position_rad + 5e-4) for r in records])
    assert sound == []
    ((_, text),) = told
    assert text.startswith("RMS error 0.5") and "mrad in brisk motion, promised 0.197 mrad" in text


def test_a_set_without_a_certificate_promises_nothing(certified: GainSet, tmp_path: Path) -> None:
    bare = certified.model_copy(update={"certificate": None})
    assert Expected.of(bare) is None
    assert PromiseWatch(Expected.of(bare)).status()["judged"] is False
    pd = load_gains(shipped("gains/demo_pd.yaml"))
    assert Expected.of(pd) is None


def test_cycles_without_control_or_feedback_count_for_nothing(certified: GainSet, tmp_path: Path) -> None:
    records = moved(joint(friction=1.5), certified, tmp_path, BRISK)[:3000]
    changes = ({"axis_state": 0}, {"encoder_age": 1}, {"controller": records[0].controller + 1})
    for some in (*([r._replace(**change) for r in records] for change in changes), records[::2]):
        watch = PromiseWatch()
        watch.begin(records[0].controller, Expected.of(certified))
        assert watch.see(some) == []
        assert watch.motion_s == 0.0


@pytest.mark.serial
def test_the_daemon_tells_by_fault_status_metrics_and_command(
    certified: GainSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with daemon_axis(joint(inertia=2.0), certified, tmp_path, 0) as axis:
        axis.run(ReferenceMotion.sine(0.01, 6.0, 5.0))
        socket = ["--socket", str(tmp_path / "axis.sock")]
        assert axis.status().enabled
        assert run(["status", *socket]) == 0
        told = capsys.readouterr().out
        assert run(["faults", *socket, "--json"]) == 0
        found = capsys.readouterr().out
        assert run(["status", *socket, "--json"]) == 0
        promise = json.loads(capsys.readouterr().out)["promise"]
    assert re.search(r"not as certified inertia (1\.[89]|2\.[01])\d times the model's", told)
    assert "PROMISE_BROKEN" in found
    assert promise["judged"] and [row["told"] for row in promise["joint"]] == [True, False, False]


def windows() -> Iterator[tuple[list[float], float]]:
    """Of a joint with shares 1.3, 0.8 and 1.1, without an error."""
    for n in range(400):
        change, friction = 3e-4 * math.sin(0.7 * n), 8e-4 * (1.0 + 0.2 * math.cos(n))
        row = [change, friction, 0.0] if n % 7 < 4 else [change, 0.0, -friction]
        yield row, 1.3 * row[0] + 0.8 * row[1] + 1.1 * row[2]


def test_shares_without_noise_are_found() -> None:
    shares = Shares()
    for row, found in windows():
        shares.add(row, found, 1e-5)
    assert shares.values == pytest.approx([1.3, 0.8, 1.1], abs=1e-3)


ROW = st.tuples(st.floats(-1.0, 1.0), st.floats(0.0, 1.0), st.floats(-1.0, 0.0), st.floats(-2.0, 2.0))


@given(st.lists(ROW, min_size=1, max_size=40))
@example([(0.0, 0.0, 0.0, 0.0)])
def test_shares_are_the_weighted_least_squares_with_the_prior(rows: list[tuple[float, float, float, float]]) -> None:
    shares = Shares()
    for *row, found in rows:
        shares.add(row, found, 0.1)
    weight = np.sqrt((1.0 - 1.0 / 250.0) ** np.arange(len(rows))[::-1]) / 0.1
    a = np.vstack([np.array([row[:3] for row in rows]) * weight[:, None], 2.0 * np.eye(3)])
    b = np.concatenate([np.array([row[3] for row in rows]) * weight, 2.0 * np.ones(3)])
    assert shares.values == pytest.approx(np.linalg.lstsq(a, b, rcond=None)[0].tolist(), rel=1e-6, abs=1e-6)
