"""Several scenarios in one file: names, values in their places, and what is refused."""

from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.qualify.faults.judge import loss_of
from servod.qualify.faults.scenario import Loss
from servod.qualify.faults.variants import load_all, load_scenarios

HEAD = "title: $count frames\nwhy: x\ngroup: bus\ninject: [{do: {frames: {of: torque, fault: drop, count: $count}}}]\n"
EXPECT = "expect: $expect\n"
ROWS = """for_each:
  - {name: one, count: 1, expect: {axis: [ENABLED]}}
  - {name: 2, count: 2, expect: {axis: [FAULT], torque_gone_ms: 300}}
"""


def written(folder: Path, text: str, name: str = "lost.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_each_row_is_a_scenario_with_its_values(tmp_path: Path) -> None:
    found = load_scenarios(written(tmp_path, HEAD + EXPECT + ROWS))
    assert list(found) == ["lost/one", "lost/2"]
    assert [s.title for s in found.values()] == ["1 frames", "2 frames"]
    assert [s.inject[0].arguments["count"] for s in found.values()] == [1, 2]
    assert [s.expect.axis for s in found.values()] == [["ENABLED"], ["FAULT"]]


def test_a_file_without_rows_is_one_scenario(tmp_path: Path) -> None:
    text = HEAD.replace("$count", "3") + "expect: {axis: [ENABLED]}\n"
    (scenario,) = load_scenarios(written(tmp_path, text)).values()
    assert (scenario.title, loss_of(scenario)) == ("3 frames", Loss.NONE)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEAD + EXPECT + "for_each: 3\n", "for_each: found 3"),
        (HEAD + EXPECT + "for_each: []\n", "a list of rows"),
        (HEAD + EXPECT + "for_each: [{count: 1}]\n", "for_each.0"),
        (HEAD + EXPECT + ROWS + "  - {name: one, count: 1, expect: {axis: [ENABLED]}}\n", "no other row has"),
        (HEAD + EXPECT + "for_each: [{name: a, count: 1}]\n", "no expect"),
        (HEAD + EXPECT + ROWS.replace("count: 2", "count: many"), "lost.yaml (2): inject.0.do.frames: count"),
        (HEAD + EXPECT + ROWS.replace("count: 2", "count: 2, loss: x"), "for_each.1.loss: found a value that nothing"),
        (
            HEAD + EXPECT + ROWS.replace("[ENABLED]", "[ENABLED], strays_rad: 0.051"),
            "strays_rad: found 0.051; allowed: at",
        ),
        ("title: x\n", "a value; this key is required"),
        ("- 1\n", "a mapping of keys"),
        (HEAD.replace("frames:", "frame:") + EXPECT + ROWS, "found 'frame'; allowed: one of"),
        (HEAD + EXPECT + ROWS.replace("[FAULT]", "[BROKEN]"), "axis.0: found 'BROKEN'; allowed: one of BRAKING"),
        (HEAD + EXPECT + ROWS.replace("count: 2", "count: 200").replace("300", "301"), "torque_gone_ms of at most 300"),
        (HEAD + EXPECT + ROWS.replace(", torque_gone_ms: 300", ""), "has a time for it"),
        (HEAD + EXPECT + ROWS.replace("[FAULT]", "[ENABLED, FAULT]"), "a scenario has one end"),
        (HEAD + EXPECT + ROWS.replace("300}", f"300, exempt: {'x' * 20}}}"), "no exemption"),
        (HEAD.replace("group", "start: proving\nruns: processes\ngroup") + EXPECT + ROWS, "for runs: stepped"),
    ],
)
def test_what_does_not_fit_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(BadInput) as error:
        load_scenarios(written(tmp_path, text))
    assert words in str(error.value)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)


def test_two_files_of_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    paths = [written(folder, HEAD + EXPECT + ROWS) for folder in (tmp_path, tmp_path / "other")]
    with pytest.raises(BadInput, match="a second scenario lost/"):
        load_all(paths)
