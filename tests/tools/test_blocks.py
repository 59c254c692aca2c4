"""The commands of tutorials and how-tos do what the pages say: they are run as they stand, or say why they are not."""

from __future__ import annotations

import re
from pathlib import Path

import blocks
import pytest
import readme

PAGES = blocks.pages()
RUN = [page for page in PAGES if blocks.runs(page)]
#: Run with another page behind them, in the same shell: not alone as well.
BEFORE = {
    page.parent / word.removeprefix("after ") for page in RUN for word in blocks.options(page) if "after " in word
}


def name(page: Path) -> str:
    return str(page.relative_to(readme.DOCS))


def long(page: Path) -> bool:
    return "long" in blocks.options(page)


def test_every_block_says_whether_it_is_run() -> None:
    """`<!-- run -->` or `<!-- not run: REASON -->` above it; see blocks.py."""
    every = [block for page in PAGES for block in blocks.blocks(page)]
    assert every and [str(block) for block in every if block.mark is None] == []
    assert [str(block) for block in every if block.mark and not block.mark.run and not block.mark.words[0]] == []


def test_every_option_of_a_mark_is_known() -> None:
    words = {word for page in PAGES for word in blocks.options(page)}
    assert words - {"long", "on an axis"} == {word for word in words if word.startswith("after ")}
    assert [str(page) for page in BEFORE if page not in RUN] == []


def test_commands_stand_in_fences_and_not_in_indented_lines() -> None:
    """An indented block has no mark, so nobody would know whether it is run."""
    indented = [
        f"{name(page)}: {line}"
        for page in PAGES
        for line in page.read_text().splitlines()
        if line.startswith(("    servoctl ", "    servod ", "    python ", "    ./"))
    ]
    assert indented == []


def test_a_mark_is_of_its_block_or_of_all_that_follow(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```sh\nzero\n```\n<!-- run: long, on an axis -->\n\n```sh\none\n```\n\n1. a\n   <!-- not run: root -->\n"
        "   ```sh\n   two\n     three\n   ```\n\n```yaml\nno: sh\n```\n\n```sh\nfour\n```\n"
    )
    axis = blocks.Mark(True, ("long", "on an axis"))
    assert [(b.line, b.text, b.mark) for b in blocks.blocks(page)] == [
        (1, "zero\n", None),
        (6, "one\n", axis),
        (12, "two\n  three\n", blocks.Mark(False, ("root",))),
        (21, "four\n", axis),
    ]


def test_a_command_that_fails_ends_the_page(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="one"):
        blocks.run("echo one; false\ntouch reached\n", tmp_path, 10.0)
    assert not (tmp_path / "reached").exists()


@pytest.mark.serial
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name(page), marks=[pytest.mark.long, pytest.mark.timeout(1200)] if long(page) else [])
        for page in RUN
        if page not in BEFORE
    ],
)
def test_the_commands_of_a_page_work_as_they_stand(page: Path, tmp_path: Path) -> None:
    blocks.run(blocks.script(page), tmp_path, 1100.0 if long(page) else 100.0)


def test_the_check_of_the_first_configuration_prints_what_the_page_shows(tmp_path: Path) -> None:
    """To the letter, but for `…`: lines that are left out there are questions of whoever meets them."""
    page = readme.DOCS / "tutorials/first-axis.md"
    first = blocks.blocks(page)[0].text
    assert first.endswith("servoctl config check out/axis/axis.yaml\n")
    shown = page.read_text().partition(f"{first}```\n\n```\n")[2].partition("\n```")[0]
    pattern = ".*".join(re.escape(part) for part in shown.split("…"))
    assert "not computed" in shown and re.fullmatch(f"{pattern}\n", blocks.run(first, tmp_path, 60.0))
