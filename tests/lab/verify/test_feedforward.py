"""What a law adds beside its feedback: refused where the model has no such thing, not where a synthesis made it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from servod.common.errors import BadInput
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, load_gains, require_same_loop
from servod.lab.verify.checks import Subject, check_loop, check_rate
from servod.lab.verify.feedforward import check_feedforward
from tests.lab.synthesize.designs import table1_set

CERTIFIED = Path(__file__).resolve().parents[3] / "gains/demo_local_certified.yaml"
AXIS: dict[str, Any] = {
    "limits": {
        "torque_nm": 0.3,
        "torque_rate_nm_per_s": 200.0,
        "speed_rad_s": 3.0,
        "position_min_rad": -1.0,
        "position_max_rad": 1.0,
        "following_error_rad": 0.2,
        "encoder_mismatch_rad": 0.05,
    },
    "gains": {"initial": "set.yaml"},
}


def demo_set() -> GainSet:
    """The certified set of the demo's joint: friction that differs by direction, and cogging."""
    return load_gains(CERTIFIED)


def subject(gains: GainSet) -> Subject:
    assert gains.design is not None
    return Subject(gains, gains.design, 4, 1, 1)


def refused(gains: GainSet) -> list[str]:
    return [check.name for check in check_feedforward(subject(gains)) if not check.passed]


def with_parameters(change: dict[str, Any]) -> GainSet:
    """The demo's set with some of its parameters replaced, sealed again."""
    data = demo_set().model_dump(mode="json", exclude_none=True)
    for path, value in change.items():
        *way, last = path.split(".")
        here = data["parameters"]
        for key in way:
            here = here[key]
        here[last] = value
    return GainSet.model_validate(data).sealed()


def sets(change: Any) -> list[dict[str, float]]:
    """The demo's local sets, each through `change`."""
    rows = demo_set().model_dump(mode="json")["parameters"]["friction"]["sets"]
    return sorted((change(dict(row)) for row in rows), key=lambda row: row["velocity_rad_s"])


@pytest.mark.parametrize("gains", [table1_set(), demo_set()], ids=["table1", "demo"])
def test_what_a_synthesis_makes_is_the_models(gains: GainSet) -> None:
    assert refused(gains) == []


def test_both_directions_friction_exchanged() -> None:
    mirrored = sets(lambda row: row | {"velocity_rad_s": -row["velocity_rad_s"]})
    assert refused(with_parameters({"friction.sets": mirrored})) == [
        "friction compensated beyond its interval, as a share of it"
    ]


def test_two_thirds_too_much_friction() -> None:
    strong = sets(lambda row: row | {"decay_per_s": row["decay_per_s"] / 1.67})
    change = {"friction.sets": strong, "friction.friction_limit_nm": 0.3}
    assert refused(with_parameters(change)) == ["friction compensated beyond its interval, as a share of it"]


@pytest.mark.parametrize("factor", [0.5, 0.8])
def test_a_map_with_a_hole_is_not_the_joints_and_one_a_little_low_may_be(factor: float) -> None:
    """One set that gives half of its friction; and all that give four fifths, as who fears too much of it may wish."""
    change = {"friction.sets": sets(lambda row: row | {"decay_per_s": row["decay_per_s"] / factor})}
    if factor == 0.5:
        rows = sets(dict)
        rows[-2]["decay_per_s"] /= factor
        change = {"friction.sets": rows}
    expected = ["friction left out below its interval, as a share of it"] if factor == 0.5 else []
    assert refused(with_parameters(change)) == expected


@pytest.mark.parametrize(
    "change",
    [
        {"waves": [{"amplitude_nm": 0.1, "waves_per_turn": 5.0}]},
        {"offset_nm": 0.05},
        {"spring_nm_per_rad": 0.1},
        {"spring_cubic_nm_per_rad3": 0.1},
        {"waves": [{"amplitude_nm": 0.001997, "waves_per_turn": 22.0, "phase_rad": 0.7 + 3.14}]},
    ],
)
def test_torque_over_position_that_no_model_has(change: dict[str, Any]) -> None:
    known = {"position_feedforward." + key: value for key, value in change.items()}
    assert refused(with_parameters(known)) == ["torque over position that the model has not [N*m]"]


def test_a_law_may_know_only_part_of_what_the_model_has() -> None:
    assert refused(with_parameters({"position_feedforward.waves": []})) == []


def test_a_spring_and_a_weight_that_the_model_has() -> None:
    """Of one torque gain, at their rests and phases; the same spring around another rest is another spring."""
    data = demo_set().model_dump(mode="json", exclude_none=True)
    data["design"]["model"] |= {"spring": {"stiffness": 0.2, "cubic": 0.05, "rest": 0.1}, "torque_offset": 0.01}
    known = {"spring_nm_per_rad": 0.2, "spring_cubic_nm_per_rad3": 0.05, "spring_rest_rad": 0.1, "offset_nm": -0.01}
    data["parameters"]["position_feedforward"] |= known
    assert refused(GainSet.model_validate(data).sealed()) == []
    data["parameters"]["position_feedforward"]["spring_rest_rad"] = -0.1
    assert refused(GainSet.model_validate(data).sealed()) == ["torque over position that the model has not [N*m]"]


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"feedforward_inertia_kg_m2": 0.0013}, "inertia of the feed-forward over the model's"),
        ({"position_feedforward.lead_s": 0.05}, "lead of the feed-forward [s]"),
        ({"friction.lead_s": 0.02}, "lead of the feed-forward [s]"),
    ],
)
def test_inertia_and_leads(change: dict[str, Any], name: str) -> None:
    assert refused(with_parameters(change)) == [name]


def test_a_gain_in_sets_between_all_speeds_of_a_grid() -> None:
    """A narrow set with a strong l_i, which is zero in its neighbours."""
    narrow = sets(dict)
    decay = 0.5 * (narrow[-1]["decay_per_s"] + narrow[-2]["decay_per_s"])
    for speed, gain in ((0.3785, 0.0), (0.379, 3.0), (0.3795, 0.0)):
        narrow.append({"velocity_rad_s": speed, "decay_per_s": decay, "gain": gain})
    narrow.sort(key=lambda row: row["velocity_rad_s"])
    failed = [c.name for c in check_loop(subject(with_parameters({"friction.sets": narrow}))) if not c.passed]
    assert "largest pole, inner points, dense speeds" in failed


def test_the_torque_rate_is_judged_and_bound() -> None:
    """A step of 10 mrad under 3 N*m/s swings for ever: such an axis may not have the set."""
    slow = demo_set()
    assert slow.design is not None
    slow = slow.model_copy(update={"design": slow.design.model_copy(update={"torque_rate_nm_per_s": 3.0})})
    assert not all(check.passed for check in check_rate(subject(slow)))
    needed = demo_set().certificate
    assert needed is not None and needed.torque_rate_nm_per_s is not None and needed.torque_rate_nm_per_s > 3.0
    require_same_loop(demo_set(), AxisConfig.model_validate(AXIS))
    axis = AxisConfig.model_validate(AXIS | {"limits": AXIS["limits"] | {"torque_rate_nm_per_s": 3.0}})
    with pytest.raises(BadInput, match=r"certificate\.torque_rate_nm_per_s.*at most 3"):
        require_same_loop(demo_set(), axis)
