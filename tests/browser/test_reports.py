"""Every page is looked at: whoever writes one has a command in the list that `scripts/browser` goes through."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from servod.lab.recordings import load_recording
from tests.browser import reports

#: Pages are made of these.
PAGES = {"servod.lab.report.page.Page", "servod.lab.report.diagnosis.DiagnosisReport"}
HOUSE = Path(__file__).parents[1] / "tools"


def test_every_writer_of_a_page_has_a_report() -> None:
    sys.path.insert(0, str(HOUSE))
    import source

    writers = {
        source.module_name(file)
        for file in source.files("servod")
        if PAGES & {name for name, _ in source.imports(file)}
    }
    assert writers | {"servod.lab.report.diagnosis"} == {report.module for report in reports.REPORTS}


def test_names_are_folders_of_their_own() -> None:
    names = [report.name for report in reports.REPORTS]
    assert len(set(names)) == len(names) and {page.partition("/")[0] for page in reports.BESIDE} <= set(names)


def test_the_fast_sine_is_a_recording(tmp_path: Path) -> None:
    reports.write_sine(tmp_path / "sine.csv")
    found = load_recording(tmp_path / "sine.csv", None)
    assert len(found.t_s) == reports.SINE_ROWS and abs(found.t_s[-1] - 59.999) < 1e-9


def test_the_check_of_a_clean_checkout_looks_at_the_pages() -> None:
    assert re.search(r"^(taskset .* )?scripts/browser --install$", (reports.ROOT / ".ci/run").read_text(), re.MULTILINE)
    assert (reports.ROOT / "scripts/browser").stat().st_mode & 0o111
