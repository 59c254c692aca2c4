"""The manual's tables that come from the code. `python tests/tools/readme.py` writes them again.

Each stands between two marks in one page of `docs`. `--measure` first runs `servoctl bench`, `servoctl qualify paper`
and `servoctl demo --fast` with the manual's gain sets (twenty minutes on an idle machine) and writes what they print;
`--bench FILE`, `--paper FILE` and `--demo FILE` take documents that were kept (--json). `--soak FILE` (again for more),
`--faults FILE` and `--fuzz FILE`, given together, write the table of reliability (`--faults` also the times of the
failure modes in docs/safety.md) from the documents of
`servoctl qualify soak`, `servoctl qualify faults` and `python -m tests.fuzz.run`.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import command_line
import reference
import reliability
import safety_trace
import stops
from tables import markdown

from servod.common.faults import FAULTS
from servod.common.shipped import shipped
from servod.drivers.quirks import QUIRKS, CommandDeadline
from servod.qualify.bench.plan import TARGETS
from servod.qualify.bench.plan import shown as shown_figure
from servod.qualify.demo.axis import CERTIFIED
from servod.qualify.demo.entries import entries
from servod.qualify.paper.table import quotation

#: Gain sets beside the four controllers in the manual: the local law without each option and without any, with
#: scheduled feedback, and Table I in both readings of its gain labels.
BESIDE = (
    "demo_local_no_observer",
    "demo_local_measured",
    "demo_local_plain",
    "demo_local_stiff",
    "table1_kz_kv_kx",
    "table1_kx_kv_kz",
)
#: What the paper measured on its laboratory joint.
PAPER_MRAD = {
    "pd_dob": "0.6916",
    "pd_lugre": "0.5006",
    "local": "0.3781",
    "table1_kz_kv_kx": "0.3781",
    "table1_kx_kv_kz": "0.3781",
}

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
#: The page of each table.
PAGES = {
    "faults": DOCS / "reference/faults.md",
    "quirks": DOCS / "reference/drives.md",
    "deadlines": DOCS / "reference/drives.md",
    "config": DOCS / "reference/configuration.md",
    "bench": DOCS / "reference/measured.md",
    "demo": DOCS / "reference/measured.md",
    "paper": DOCS / "explanation/paper.md",
    "reliability": DOCS / "explanation/reliability.md",
    "servoctl": DOCS / "reference/cli.md",
    "servod": DOCS / "reference/cli.md",
    "servod_virtual_axis": DOCS / "reference/cli.md",
    "axis_model": DOCS / "reference/axis-model.md",
    "gain_set": DOCS / "reference/gain-set.md",
    "record": DOCS / "reference/recording.md",
    "record_numbers": DOCS / "reference/recording.md",
    "virtual_axis": DOCS / "reference/cli.md",
    "columns": DOCS / "reference/recording.md",
    "spellings": DOCS / "reference/recording.md",
    "protocol": DOCS / "reference/protocol.md",
    "json": DOCS / "reference/json.md",
    "requirements": DOCS / "reference/safety-trace.md",
    "supply": DOCS / "reference/safety-trace.md",
    "stops": DOCS / "safety.md",
}


def texts() -> list[Path]:
    """Everything that is written for people: the front door and every page of the manual."""
    return [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]


def faults() -> str:
    """Every fault, its reaction, cause and remedy."""
    rows = [[f"`{f.code.name}`", f.reaction.name.lower().replace("_", " "), f.cause, f.remedy] for f in FAULTS.values()]
    return markdown(["Fault", "Reaction", "Cause", "Remedy"], rows)


def quirks() -> str:
    """Every documented deviation of a real drive, with its source."""
    rows = [
        [f"`{name}`", row.maker, deviation.text, deviation.source]
        for name, row in QUIRKS.items()
        for deviation in row.deviations
    ]
    return markdown(["`amplifier.quirks`", "Maker", "Deviation", "Source"], rows)


def deadlines() -> str:
    """What is known of each maker's deadline of the commands, and what servod makes of it."""
    counts = {
        CommandDeadline.STOPS: "the deadline, where the drive shows that it stops by it",
        CommandDeadline.TELLS: "the heartbeat",
        CommandDeadline.MISSING: "the heartbeat",
    }
    rows = [
        [f"`{name}`", row.maker, row.deadline_source.text, row.deadline_source.source, counts[row.command_deadline]]
        for name, row in QUIRKS.items()
    ]
    return markdown(["`amplifier.quirks`", "Maker", "What is known of 0x1400:5", "Source", "Counts as the guard"], rows)


TABLES: dict[str, Callable[[], str]] = {
    "faults": faults,
    "quirks": quirks,
    "deadlines": deadlines,
    "servoctl": command_line.servoctl,
    "servod": command_line.servod,
    "servod_virtual_axis": command_line.servod_virtual_axis,
    "axis_model": reference.axis_model,
    "gain_set": reference.gain_set,
    "record": reference.record,
    "record_numbers": reference.record_numbers,
    "virtual_axis": reference.virtual_axis,
    "columns": reference.columns,
    "spellings": reference.unit_spellings,
    "protocol": reference.protocol,
    "json": reference.json_documents,
    "requirements": safety_trace.requirement_table,
    "supply": safety_trace.supply_table,
    "stops": stops.stops_table,
}


def written() -> dict[Path, str]:
    """The pages of the tables of the code, each with its tables as the code has them now."""
    pages: dict[Path, str] = {}
    for name, table in TABLES.items():
        pages[PAGES[name]] = with_section(pages.get(PAGES[name]) or PAGES[name].read_text(), name, table())
    return pages


def measured(document: dict[str, Any]) -> str:
    """The benchmark's figures beside their targets, and the machine they were measured on."""
    machine = document["machine"]
    rows = []
    for target in TARGETS:
        rows.append([target.label, shown_figure(document, target), target.bound, target.verdict(document)])
    wall_s, memory_s = document["wall_clock"]["seconds"], document["memory"]["seconds"]
    return (
        f"Measured by `servoctl bench` on {machine['cpu']}, {machine['cores']} cores, Linux {machine['kernel']}, "
        f"Python {machine['python']}; wall clock over {wall_s:.0f} s, memory over {memory_s:.0f} s.\n\n"
        + markdown(["Figure", "Measured", "Target", ""], rows)
    )


def with_section(text: str, name: str, content: str) -> str:
    """`text` with the part between the marks of `name` replaced."""
    pattern = re.compile(rf"(<!-- {name}: from the code -->\n).*?(<!-- {name}: end -->)", re.DOTALL)
    assert pattern.search(text), f"{PAGES[name]} has no part {name}"
    return pattern.sub(lambda m: f"{m[1]}{content}\n{m[2]}", text)


def demo_arguments() -> list[str]:
    """The demo that the manual's table of tracking errors comes from."""
    return ["demo", "--fast", *(word for name in BESIDE for word in ("--gains", f"gains/{name}.yaml"))]


def tracking(document: dict[str, Any]) -> str:
    """Every row of the demo's table with the options of its law, beside what the paper measured on its joint."""
    scores = document["controllers"] | document["others"]
    rows = []
    beside = [shipped(f"gains/{name}.yaml") for name in BESIDE]
    for row in entries(beside, certified=CERTIFIED in document["others"]):
        score = scores[row.name]
        rms, largest = (f"{score[f'{kind}_error_mrad']:.3f}" for kind in ("rms", "max"))
        rows.append([row.label if row.label != row.name else "", f"`{row.gains.stem}`", row.options, rms, largest])
        rows[-1].append(PAPER_MRAD.get(row.name, ""))
    header = ["Controller", "Gain set", "Options", "RMS / mrad", "Largest / mrad", "Paper, RMS / mrad"]
    return f"```sh\nservoctl {' '.join(demo_arguments())}\n```\n\n{markdown(header, rows)}"


def printed(arguments: list[str], folder: str) -> dict[str, Any]:
    """The JSON document of one command of servoctl."""
    command = [sys.executable, "-m", "servod.cli", *arguments, "--json"]
    if {"demo", "paper"} & {*arguments[:2]}:
        command += ["--out", folder]
    document: dict[str, Any] = json.loads(subprocess.run(command, stdout=subprocess.PIPE, cwd=ROOT, check=True).stdout)
    return document


def main() -> None:
    """Write the tables, and what was measured when that is asked for or given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true", help="run the commands and write what they print")
    parser.add_argument("--bench", type=Path, help="document of `servoctl bench --json`")
    parser.add_argument("--demo", type=Path, help="document of the manual's `servoctl demo --json`")
    parser.add_argument("--paper", type=Path, help="paper.json of `servoctl qualify paper`")
    parser.add_argument("--soak", type=Path, action="append", default=[], help="soak.json of `servoctl qualify soak`")
    parser.add_argument("--faults", type=Path, help="document of `servoctl qualify faults --json`")
    parser.add_argument("--fuzz", type=Path, help="document of `python -m tests.fuzz.run --json`")
    options = parser.parse_args()
    documents = {name: json.loads(file.read_text()) for name in MEASURED if (file := getattr(options, name))}
    if options.measure:
        with tempfile.TemporaryDirectory(prefix="servod-readme-") as folder:
            commands = {"demo": demo_arguments(), "bench": ["bench"], "paper": ["qualify", "paper"]}
            documents = {name: printed(arguments, folder) for name, arguments in commands.items()}
    for page, text in written().items():
        page.write_text(text)
    for name, document in documents.items():
        write(name, MEASURED[name](document))
    tried = reliability_rows(options.soak, options.faults, options.fuzz)
    if tried:
        write("reliability", markdown(reliability.HEADER, tried))
    if options.faults:
        page = DOCS / "safety.md"
        page.write_text(reliability.with_times(page.read_text(), json.loads(options.faults.read_text())))


def write(name: str, content: str) -> None:
    """Put `content` between the marks of `name` in its page."""
    PAGES[name].write_text(with_section(PAGES[name].read_text(), name, content))


def reliability_rows(soaks: list[Path], faults: Path | None, fuzz: Path | None) -> list[list[str]]:
    """The rows of the table of reliability from the documents that are given."""
    campaign, fuzzed = (None if file is None else json.loads(file.read_text()) for file in (faults, fuzz))
    return reliability.rows([json.loads(file.read_text()) for file in soaks], campaign, fuzzed)


MEASURED: dict[str, Callable[[dict[str, Any]], str]] = {
    "bench": measured,
    "demo": tracking,
    "paper": quotation,
}

if __name__ == "__main__":
    main()
