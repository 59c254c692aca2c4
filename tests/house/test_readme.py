"""What the README says of the code is what the code says."""

from __future__ import annotations

import source

from servod.errors import FAULTS

README = source.ROOT / "README.md"
BEGIN, END = "<!-- faults: begin (python -m tests.house.test_readme writes this) -->", "<!-- faults: end -->"


def fault_table() -> str:
    """The fault table as Markdown."""
    lines = ["| Fault | Reaction | Cause | Remedy |", "| --- | --- | --- | --- |"]
    lines += [
        f"| `{f.code.name}` | {f.reaction.name.lower().replace('_', ' ')} | {f.cause} | {f.remedy} |"
        for f in FAULTS.values()
    ]
    return "\n".join(lines)
