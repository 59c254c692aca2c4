"""`servoctl identify` by its exit codes and its document; what it makes and finds is in test_walk."""

from __future__ import annotations

import pytest

from servod.cli.app import run
from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.lab.identify.store import LIST, Recordings


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "--config"),
        (["--recordings", "nowhere"], "nowhere"),
        (["--plant", "nowhere.yaml"], "nowhere.yaml"),
        (["--before", str(shipped("gains/axes/table1_joint.yaml"))], "identified"),
    ],
)
def test_bad_input_is_one_line(options, said, tmp_path, capsys):
    assert run(["identify", "--out", str(tmp_path / "model.yaml"), *options]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert said in captured.err
    assert not (tmp_path / "model.yaml").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[]", "found a list as earlier versions wrote it"),
        ("not json", "Expecting value"),
        ('{"conditions": "", "start_rad": 0.0}', "experiments: found nothing"),
        ('{"conditions": "", "start_rad": 0.0, "experiments": [{}]}', "experiments.0.file: found nothing"),
        (
            '{"conditions": "", "start_rad": 0, "experiments": [{"file": "../a", "kind": "noise", "motion": "", '
            '"settings": {}}]}',
            "experiments.0.file: found '../a'",
        ),
        (
            '{"conditions": "", "start_rad": 0, "experiments": [{"file": "00_noise.mcap", "kind": "noise", '
            '"motion": "", "settings": {}}]}',
            "00_noise.mcap: there is no such file; needed: the recording",
        ),
    ],
)
def test_recordings_of_another_kind_are_one_line(text, said, tmp_path, capsys):
    folder = tmp_path / "model_recordings"
    folder.mkdir()
    (folder / LIST).write_text(text)
    assert run(["identify", "--out", str(tmp_path / "model.yaml"), "--recordings", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and said in error


def test_an_old_list_does_not_stop_a_new_walk_but_one_that_goes_on(tmp_path):
    (tmp_path / LIST).write_text("[]")
    with pytest.raises(BadInput, match="earlier versions"):
        Recordings(tmp_path, resume=True)
    assert Recordings(tmp_path).waiting == 0
