"""The frame of every page: verdict, signature, tables that begin with what failed, HTML that a screen reader reads."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import servod
from servod.client.virtual import virtual_config
from servod.common.shipped import shipped
from servod.formats.config import AmplifierConfig, Identity
from servod.formats.gains.gain_set import CertificateCheck, GainSet, load_gains
from servod.formats.recording.mcap_writer import McapFile
from servod.formats.recording.record import FIELDS, RECORD, CycleRecord
from servod.lab.report.figure import Colour, Figure, PageTable, PlotAxis, PlotPanel, curve
from servod.lab.report.figures.loop import PASSED, certificate_tables, limit_used, observations_table
from servod.lab.report.page import Origin, Page, Verdict, _is_text, drives
from servod.lab.verify.margins import DELAY, PHASE

ROOT = Path(__file__).resolve().parents[3]


class Tags(HTMLParser):
    """Every element with its attributes, in the order of the page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]


def a_page(origin: Origin | None = None) -> Page:
    page = Page("A page", Verdict("3 of 3 hold", True), origin)
    page.heading("Figures")
    t = np.arange(10.0)
    panel = PlotPanel(PlotAxis("time in s"), PlotAxis("error in mrad"), (curve("a", t, t), curve("b", t, -t)))
    page.figure(Figure("errors", "Errors", (panel,), caption="Both of them."))
    page.table(PageTable("A table", ("check", "figure", "verdict"), (("one", "0.5", "failed"), ("two", "–", "passed"))))
    page.table(PageTable("The rest", ("check", "figure"), (("three", "1"),)), folded=True)
    return page


def test_a_page_begins_with_verdict_and_signature(tmp_path: Path) -> None:
    """Who, when, on what, from what: every file by its whole hash, a list by one hash over all, drives by identity."""
    files = [tmp_path / name for name in ("model.yaml", "a.mcap", "b.mcap")]
    for file in files:
        file.write_text(file.name)
    axis = virtual_config(tmp_path, 1000, 2**20).model_copy(
        update={"amplifier": AmplifierConfig(identity=Identity(vendor_id=0xFB, product_code=0x6400, serial=4711))}
    )
    gone = tmp_path / "gone.yaml"
    origin = Origin({"model": files[0], "recordings": files[1:], "map": gone}, axis, facts={"axis": "virtual"})
    text = a_page(origin).html()
    assert text.index("<h1") < text.index('id="verdict"') < text.index('id="signature"') < text.index("<main>")
    assert '<p id="verdict" class="passed">Passed: 3 of 3 hold</p>' in text
    for file in files:
        assert f">{hashlib.sha256(file.read_bytes()).hexdigest()}</code>" in text
    assert "vendor 0xfb, product 0x6400, serial 4711" in text and "identity not stated" in text
    assert "2 files" in text and "gone.yaml" not in text and "<dt>axis</dt><dd>virtual</dd>" in text
    told = {"role": "encoder", "node_id": 2, "driver": "cia406", "identity": {"vendor_id": 0x2E4, "serial": None}}
    assert drives(Origin(axis=axis, nodes=[told])) == ["encoder, node 2, driver cia406: vendor 0x2e4"]
    signed = re.search(r'<section id="signature".*?</section>', text)
    assert signed
    stamp = r"<dt>drawn</dt><dd>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC \(here .*[+-]\d\d:\d\d\)"
    for part in (stamp, servod.__version__, "numpy", "Linux"):
        assert re.search(part, signed[0])


def test_a_page_is_the_same_whatever_the_machine_takes_files_for() -> None:
    """Its script has more than ASCII, which Windows, too, would read by a code page."""
    code = (
        "import sys; from tests.lab.report.test_page import a_page\n"
        "sys.stdout.buffer.write(a_page().html().encode('utf-8'))"
    )
    elsewhere = os.environ | {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    told = subprocess.run([sys.executable, "-c", code], env=elsewhere, cwd=ROOT, capture_output=True, check=True)
    drawn = re.compile(r"<dt>drawn</dt><dd>[^<]*</dd>")
    here, there = (drawn.subn("", page) for page in (a_page().html(), told.stdout.decode()))
    assert there == here and here[1] == 1


def test_no_name_acts_on_what_stands_beside_it(tmp_path: Path) -> None:
    """A name that turns the writing direction would turn the hash behind it; one in Latin-1 is no text at all."""
    bent = tmp_path / "run\u202e\u2067cam.gnp"
    latin = tmp_path / os.fsdecode(b"caf\xe9.mcap")
    for file in (bent, latin):
        file.write_bytes(b"x")
    page = Page(latin.name, Verdict(bent.name), Origin({"recordings": [bent, latin], "model": bent}))
    panel = PlotPanel(PlotAxis("t"), PlotAxis(bent.name), (curve(bent.name, [0.0, 1.0], [0.0, 1.0]),), latin.name)
    page.figure(Figure(latin.stem, bent.name, (panel,)))
    page.table(PageTable(bent.name, (bent.name, latin.name), ((bent.name, latin.name),)))
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert not set("\u202e\u2067") & set(text) and "run\\u202e\\u2067cam.gnp" in text and "caf\\udce9" in text
    assert '"name": "caf\\\\udce9"' in text and 'id="figure-caf\\udce9"' in text  # page.js finds it
    assert all(f"<bdi>{name}" in text for name in ("model: run", "caf", "run")) and text.count('dir="ltr"') == 4


def recorded(text: str) -> list[str]:
    """What a page tells of when it was recorded."""
    return re.findall(r"<dt>recorded</dt><dd>(.*?)</dd>", text)


def test_a_page_tells_when_its_recordings_were_made(tmp_path: Path) -> None:
    """By the time of day of the first cycle. Virtual time, CSV and broken files tell none."""
    files = []
    zero = CycleRecord._make(0 if f.kind == "q" else 0.0 for f in FIELDS)
    for name, offset_s in (("b", 1_700_000_060), ("a", 1_700_000_000), ("virtual", 0)):
        files.append(tmp_path / f"{name}.mcap")
        file = McapFile(files[-1], {}, offset_s * 10**9)
        file.write_rows([RECORD.pack(*zero._replace(time_ns=at)) for at in (7 * 10**9, 9 * 10**9)])
        file.close()
    for name, rows in (("broken.mcap", files[0].read_bytes()[:60]), ("other.csv", b"t_s,torque_nm,position_rad\n")):
        files.append(tmp_path / name)
        files[-1].write_bytes(rows)
    (one,) = recorded(a_page(Origin({"recording": files[0]})).html())
    assert re.fullmatch(r"2023-11-14 22:14:27 UTC \(here .*\)", one)
    (several,) = recorded(a_page(Origin({"recordings": files})).html())
    assert re.fullmatch(r"2023-11-14 22:13:27 .* to 2023-11-14 22:14:27 .*, 2 of 5 files tell it", several)
    for silent in files[2:]:
        assert recorded(a_page(Origin({"recording": silent})).html()) == [
            "not told: no time of day stands in the files"
        ]
    assert recorded(a_page(Origin({"model": files[0]})).html()) == []
    (live,) = recorded(a_page(Origin(recorded_ns=1_700_000_000 * 10**9)).html())
    assert live.startswith("2023-11-14 22:13:20 UTC")


@pytest.mark.parametrize(("passed", "kind", "word"), [(False, "failed", "Refused: "), (None, "told", "")])
def test_a_verdict_that_is_no_pass_says_so(passed: bool | None, kind: str, word: str) -> None:
    assert Verdict("x < y", passed).html() == f'<p id="verdict" class="{kind}">{word}x &lt; y</p>'


def test_the_page_can_be_read_aloud_and_fits_a_phone() -> None:
    """Language, landmarks, headings in order, headers with scope, names for pictures and boxes that scroll."""
    tags = Tags(a_page().html())
    assert tags.of("html") == [{"lang": "en"}] and tags.of("main") and tags.of("header") and tags.of("footer")
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in tags.of("meta")
    levels = [int(tag[1]) for tag, _ in tags.found if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1 and all(b <= a + 1 for a, b in pairwise(levels))
    assert all(header.get("scope") in ("col", "row") for header in tags.of("th"))
    assert all(picture.get("aria-label") or picture.get("aria-hidden") for picture in tags.of("svg"))
    assert all(button.get("aria-label") or "aria-pressed" in button for button in tags.of("button"))
    boxes = [box for box in tags.of("div") if "scroll" in str(box.get("class"))]
    assert len(boxes) == 2 and all(b["tabindex"] == "0" and b["role"] == "region" and b["aria-label"] for b in boxes)
    ids = [str(attributes["id"]) for _, attributes in tags.found if "id" in attributes]
    assert len(ids) == len(set(ids))


def luminance(colour: str) -> float:
    """Of WCAG 2."""
    parts = (int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))


def test_colours_can_be_seen_in_light_in_dark_and_on_paper() -> None:
    """Text by 4.5 to 1 on page and box, curves by 3 to 1 (WCAG 2, 1.4.3 and 1.4.11); every colour there."""
    style = Path(servod.__file__).with_name("lab") / "report" / "page.css"
    themes = [
        dict(re.findall(r"--(\w+): (#\w{6})", block))
        for block in re.findall(r":root \{(.*?)\}", style.read_text(), re.S)
    ]
    assert len(themes) == 3
    for theme in themes:
        assert {colour.name.lower() for colour in Colour} <= set(theme)
        for names, least, grounds in (
            (("text", "soft", "link", "good", "bad"), 4.5, ("back", "box")),
            (tuple(colour.name.lower() for colour in Colour), 3.0, ("back",)),
        ):
            for name in names:
                for ground in grounds:
                    low, high = sorted((luminance(theme[name]), luminance(theme[ground])))
                    assert (high + 0.05) / (low + 0.05) >= least, (name, ground)


def check(name: str, value: float, limit: float, most: bool = True) -> CertificateCheck:
    margin = limit - value if most else value - limit
    return CertificateCheck(name=name, value=value, limit=limit, margin=margin, passed=margin >= 0.0)


def judged() -> GainSet:
    """A set with checks of every kind, one of them failed."""
    gains = load_gains(shipped("gains/demo_local_certified.yaml"))
    assert gains.certificate is not None
    near = [check(f"near {k}", 0.90 + 0.01 * k, 1.0) for k in range(5)]
    checks = [check("exact", 2.0, 2.0), check("far", 0.1, 1.0), *near, check("bad", 3.0, 1.0)]
    told = {PHASE: 12.03, DELAY: 0.4707, "other": 1.0}
    update = {"valid": False, "checks": checks, "observations": told}
    return gains.model_copy(update={"certificate": gains.certificate.model_copy(update=update)})


def test_what_failed_comes_first_then_the_tightest_and_the_rest_is_folded() -> None:
    margins, first, rest = certificate_tables(judged())
    assert [row[:3] for row in margins.rows] == [("phase margin", "12", "°"), ("delay margin", "0.471", "cycles")]
    assert [row[0] for row in first.rows] == ["bad", "near 4", "near 3", "near 2", "near 1", "near 0"]
    assert first.rows[0][-1] == "failed" and first.rows[1][3] == "94 %"
    assert rest.title.startswith(PASSED) and [(row[0], row[3]) for row in rest.rows] == [
        ("far", "10 %"), ("exact", "met exactly"),
    ]  # fmt: skip
    assert [row[0] for row in observations_table(judged()).rows] == ["other"]


def test_a_limit_is_used_up_from_either_side() -> None:
    assert limit_used(check("disk", 0.2, 0.1, most=False)) == pytest.approx(0.5)
    assert limit_used(check("largest pole, corners", 0.99, 0.999)) == pytest.approx(0.1)
    assert limit_used(check("plants that fail", 1.0, 0.0)) == 1.0
    assert limit_used(check("plants that fail", 0.0, 0.0)) == 0.0


def test_a_column_of_words_is_one_though_most_of_its_cells_are_empty() -> None:
    """Else its words stay on one line, and push the table off the paper."""
    assert _is_text(["-", "-", "-", "DRIVE_FAULT, COMMANDS_LOST"]) and not _is_text(["-", "-", "3.5"])
