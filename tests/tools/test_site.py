"""The manual as a site: every page has its place in it, and every link leads to a heading that is there.

`scripts/site` builds it and sees the same with Sphinx's eyes; these look without it.
"""

from __future__ import annotations

import os
import re
from urllib.parse import urlsplit

import pytest
import readme
import source

INDEX = readme.DOCS / "index.md"
#: Links of a text, with what follows the path; not those within code.
LINK = re.compile(r"\]\((?!mailto:)([^)\s]+)\)")
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)\s]+\.png)\)")
#: Octets of a picture, and of all.
MOST_BYTES, MOST_OF_ALL = 150_000, 1_500_000
CODE = re.compile(r"^```.*?^```$|`[^`\n]*`", re.DOTALL | re.MULTILINE)
TOCTREE = re.compile(r"^```\{toctree\}\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def entries() -> list[str]:
    """What the lists of the start page name, in their order; options and captions left out."""
    lines = [line.strip() for block in TOCTREE.findall(INDEX.read_text()) for line in block.splitlines()]
    return [line for line in lines if line and not line.startswith(":")]


def pattern(entry: str) -> re.Pattern[str]:
    """As Sphinx reads it: `*` within a folder, `**` across folders."""
    parts = {"**": ".*", "*": "[^/]*"}
    return re.compile("".join(parts.get(part, re.escape(part)) for part in re.split(r"(\*\*?)", entry)))


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub and MyST make them."""
    without = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#{1,4} (.+)$", without, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]|\]\([^)]*\)", "", h).lower()).replace(" ", "-") for h in headings}


def test_every_page_is_in_a_list_of_the_start_page() -> None:
    pages = [os.path.relpath(page.with_suffix(""), readme.DOCS) for page in readme.texts() if page != INDEX]
    lost = [page for page in pages if not any(pattern(entry).fullmatch(page) for entry in entries())]
    assert lost == []


def test_every_entry_of_the_lists_is_a_page() -> None:
    plain = [entry for entry in entries() if "*" not in entry]
    assert plain and [entry for entry in plain if not (readme.DOCS / f"{entry}.md").is_file()] == []


def test_every_link_leads_to_a_heading() -> None:
    wrong = []
    for page in readme.texts():
        for link in LINK.findall(CODE.sub("", page.read_text())):
            path, _, anchor = link.partition("#")
            target = page if not path else (page.parent / path).resolve()
            if "://" not in link and anchor and anchor not in anchors(target.read_text()):
                wrong.append(f"{page.relative_to(source.ROOT)}: {link}")
    assert wrong == []


def test_every_picture_is_small_and_shown_with_words_for_those_who_do_not_see_it() -> None:
    shown = {}
    for page in readme.texts():
        for words, path in PICTURE.findall(page.read_text()):
            shown[(page.parent / path).resolve()] = words
            assert len(words) > 15, f"{page.relative_to(source.ROOT)}: {path} says {words!r}"
    sizes = {file.resolve(): file.stat().st_size for file in (readme.DOCS / "pictures").iterdir()}
    assert sizes.keys() == shown.keys()
    assert [file.name for file, size in sizes.items() if size > MOST_BYTES] == []
    assert sum(sizes.values()) <= MOST_OF_ALL


def test_every_address_of_the_network_is_written_as_one() -> None:
    """Whether it answers cannot be seen where there is no network."""
    texts = {page: CODE.sub("", page.read_text()) for page in readme.texts()}
    links = [(page, link) for page, text in texts.items() for link in LINK.findall(text) if "://" in link]
    for page, link in links:
        parts = urlsplit(link)
        assert parts.scheme in ("http", "https") and "." in (parts.hostname or ""), (page, link)


def test_the_check_of_a_clean_checkout_builds_the_site_and_runs_its_commands() -> None:
    """Those of tests/tools/test_blocks.py, also of the pages that take long."""
    check = (source.ROOT / ".ci/run").read_text()
    assert re.search(r"^ *(taskset .* )?scripts/site$", check, re.MULTILINE)
    assert re.search(r"^\./test$", check, re.MULTILINE)
    assert re.search(r"^\./test -m long .*tests/tools$", check, re.MULTILINE)
    script = (source.ROOT / "scripts/site").read_text()
    assert re.search(r" -W .*-n ", script) and "sphinx linkcheck" in script
    assert (source.ROOT / "scripts/site").stat().st_mode & 0o111


@pytest.mark.parametrize("door", ["build a machine", "tune control loops", "do research", "change servod"])
def test_the_start_page_has_a_door_for_each_reader(door: str) -> None:
    assert re.search(rf"^\| \*\*{door}\*\*.*\]\(", INDEX.read_text(), re.MULTILINE)


def test_the_time_to_stop_on_the_start_page_is_that_of_the_campaign() -> None:
    """Both figures of its row: the drive left the command, the torque was gone."""
    row = r"^\| the latest of all .* lose the master: [^|]*\| (\d+) \| (\d+) \|"
    (told,) = re.findall(row, INDEX.read_text(), re.MULTILINE)
    page = readme.PAGES["reliability"].read_text()
    row = r"^\| of these, loss of master \|.* after (\d+) ms at the latest; .* gone after (\d+) ms at the latest"
    (measured,) = re.findall(row, page, re.MULTILINE)
    assert told == measured
