"""What the fault table tells people is so."""

from __future__ import annotations

import re
from pathlib import Path

from servod.common.faults import FAULTS, FaultCode
from tests.cli.test_help import COMMANDS

HOW_IT_WORKS = Path(__file__).parents[2] / "docs/explanation/how-it-works.md"


def test_a_remedy_names_only_commands_that_there_are() -> None:
    named = {match.split()[0] for f in FAULTS.values() for match in re.findall(r"`servoctl ([^`]+)`", f.remedy)}
    assert named and named <= {path[0] for path in COMMANDS}


def test_the_alarm_word_is_read_where_it_is_told() -> None:
    """No screen shows it: the node's EMCY is in the journal, and a start with an alarm is refused with the word."""
    remedy = FAULTS[FaultCode.ENCODER_ALARM].remedy
    assert "servoctl status" not in remedy
    assert "EMCY" in remedy and "journal" in remedy and "0x6503" in remedy


def test_table_and_manual_say_the_same_of_a_lost_loop() -> None:
    """The supervisor switches the drive off (`Supervisor._lose_loop`); 0x1016 is for a drive that it does not reach."""
    cause, page = FAULTS[FaultCode.LOOP_LOST].cause, HOW_IT_WORKS.read_text()
    rows = [line for line in page.splitlines() if line.startswith(("| `servod` loop |", "| loop, `kill -9` |"))]
    assert "the supervisor switched the drive off" in cause and len(rows) == 2
    assert all("the supervisor switches the drive off" in row and "0x1016" in row for row in rows)
