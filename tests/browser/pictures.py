"""Makes the pictures of docs/pictures that show reports and terminal: what a reader will see, from the commands.

    scripts/browser --pictures                   make every page, print every command, take the pictures
    scripts/browser --pictures --keep demo       those of one report, as it was made before

A report is shown as on a desk in light and, beside it, as on a phone in dark. A terminal is what a command printed on
one of 100 columns, in a folder of its own that is nobody's home: no picture shows where the checkout lies. Each picture
has a palette and is held to a size. What scripts/*_picture.py draw is not of these.
"""

from __future__ import annotations

import argparse
import io
import os
import pty
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, sync_playwright
from rich.console import Console
from rich.terminal_theme import MONOKAI
from rich.text import Text

from tests.browser import reports
from tests.browser.look import BROWSERS, chromium, open_page

FOLDER = reports.ROOT / "docs/pictures"
#: No picture has more octets, nor have all of the folder.
MOST_BYTES, MOST_OF_ALL = 150_000, 1_500_000
_DESK_PX, _PHONE_PX, _HIGH_PX, _GAP_PX = 980, 390, 1040, 24
_COLUMNS, _COLOURS = 100, 128
_MARGIN_COLOUR = "#c8ccd2"
_TERMINAL = """<!doctype html><meta charset="utf-8"><style>body {{ margin: 0; background: #14171b; }}
pre {{ display: inline-block; width: 100.5ch; white-space: pre-wrap; word-break: break-all;
margin: 0; padding: 14px 18px; background: #14171b; color: #e6e9ec;
font: 14px/1.165 "DejaVu Sans Mono", monospace; }}</style><pre><b>$ {command}</b>
{code}</pre>"""
#: What is typed in each picture of a terminal; the folder has the checkout's gains beside it.
TERMINALS: dict[str, tuple[str, ...]] = {
    "demo": ("demo", "--fast"),
    "commission": ("commission", "--plant", reports.DEMO_JOINT, "--out", "commissioning", "--yes"),
    "diagnose": (
        "diagnose",
        "--model",
        "model.yaml",
        "run1.csv.gz",
        "run2.csv.gz",
        "run3.csv.gz",
        "--out",
        "diagnosis",
    ),
}
#: The same with a virtual axis and its daemon running, one after another.
ON_AXIS: dict[str, tuple[str, ...]] = {
    "enable": ("enable",),
    "track": ("track", "sine", "--amplitude", "0.1", "--frequency", "0.5", "--duration", "6"),
    "status": ("status",),
}


def typed(words: tuple[str, ...], folder: Path, socket: Path | None = None) -> str:
    """What a command prints on a terminal, with its colours; bars, which go to standard error, are left out."""
    mine, its = pty.openpty()
    environment = os.environ | {"COLUMNS": str(_COLUMNS), "TERM": "xterm-256color", "HOME": str(folder)}
    environment |= {"SERVOD_SOCKET": str(socket)} if socket else {}
    command = [sys.executable, "-m", "servod.cli", *words]
    with subprocess.Popen(command, cwd=folder, env=environment, stdout=its, stderr=subprocess.DEVNULL) as process:
        os.close(its)
        printed = bytearray()
        while True:
            try:
                part = os.read(mine, 65536)
            except OSError:  # the other end is closed
                break
            if not part:
                break
            printed += part
    os.close(mine)
    if process.returncode:
        raise reports.Failed(f"servoctl {shlex.join(words)}: {process.returncode}")
    return printed.decode().replace("\r\n", "\n")


def terminals(pages: Path, names: set[str], folder: Path) -> Iterator[tuple[str, str]]:
    """Name and HTML of each terminal. Raises Failed where one shows the checkout."""
    for name, words, printed in _printed(pages, names, folder):
        if str(reports.ROOT) in printed:
            raise reports.Failed(f"servoctl {shlex.join(words)} shows {reports.ROOT}")
        yield name, _html(words, printed)


def _printed(pages: Path, names: set[str], folder: Path) -> Iterator[tuple[str, tuple[str, ...], str]]:
    (folder / "gains").symlink_to(reports.ROOT / "gains")
    if "commission" in names:
        shutil.copytree(pages / "commission", folder / "commissioning")
    if "diagnose" in names:
        case = pages / "diagnose/drawn/c000"
        for n, file in enumerate([case / "model.yaml", *sorted(case.glob("rec_*.gz"))]):
            shutil.copy(file, folder / (f"run{n}.csv.gz" if n else "model.yaml"))
    for name, words in TERMINALS.items():
        if name in names:
            yield name, words, typed(words, folder)
    if "track" in names:
        with reports.axis(folder / "axis") as socket:
            for name, words in ON_AXIS.items():
                yield name, words, typed(words, folder, socket)


def _html(words: tuple[str, ...], printed: str) -> str:
    console = Console(record=True, width=_COLUMNS, file=io.StringIO(), force_terminal=True, color_system="truecolor")
    console.print(Text.from_ansi(printed.rstrip("\n")), soft_wrap=True)
    command = shlex.join(("servoctl", *words)).replace("&", "&amp;").replace("<", "&lt;")
    return _TERMINAL.format(
        command=command, code=console.export_html(theme=MONOKAI, inline_styles=True, code_format="{code}")
    )


def report_picture(browser: Browser, file: Path) -> Image.Image:
    """The top of a page on a desk in light, and on a phone in dark beside it."""
    sheet = Image.new("RGB", (_DESK_PX + _GAP_PX + _PHONE_PX, _HIGH_PX), _MARGIN_COLOUR)
    for left, width, scheme in ((0, _DESK_PX, "light"), (_DESK_PX + _GAP_PX, _PHONE_PX, "dark")):
        with _page(browser, width, scheme) as page:
            open_page(page, file)
            sheet.paste(Image.open(io.BytesIO(page.screenshot())), (left, 0))
    return sheet


def terminal_picture(browser: Browser, html: str) -> Image.Image:
    """A terminal of its columns, which breaks longer lines as one does."""
    with _page(browser, 1600, "dark") as page:
        page.set_content(html)
        return Image.open(io.BytesIO(page.locator("pre").screenshot()))


@contextmanager
def _page(browser: Browser, width: int, scheme: str):
    context = browser.new_context(viewport={"width": width, "height": _HIGH_PX}, color_scheme=scheme)
    with context:
        yield context.new_page()


def save(picture: Image.Image, name: str) -> None:
    """Write it into the manual with a palette, and say its size. Raises Failed when it is too large."""
    buffer = io.BytesIO()
    few = picture.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
    few.save(buffer, format="PNG", optimize=True)
    if buffer.tell() > MOST_BYTES:
        raise reports.Failed(f"{name}.png: {buffer.tell()} octets, at most {MOST_BYTES}")
    (FOLDER / f"{name}.png").write_bytes(buffer.getvalue())
    print(f"{name}.png: {picture.width} x {picture.height}, {buffer.tell() / 1e3:.0f} kB", flush=True)


def main() -> int:
    """Make all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [report.name for report in reports.REPORTS]
    parser.add_argument("report", nargs="*", choices=[*known, []], help="which; all unless stated")
    parser.add_argument("--out", type=Path, default=Path("build/browser"), help="folder of the pages")
    parser.add_argument("--keep", action="store_true", help="take pages that were made before")
    told = parser.parse_args()
    program, out = chromium(), told.out.resolve()
    if program is None:
        sys.exit(f"browser: none of {', '.join(BROWSERS)} is installed; on Debian: apt install chromium")
    names = set(told.report or known)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"] if not os.getuid() else [])
        for file, error in reports.make(out / "pages", names - {"plot"}, told.keep, 2):  # a sine says nothing
            if error:
                raise reports.Failed(error)
            name = file.relative_to(out / "pages").parts[0] if file.stem == "report" else file.stem
            save(report_picture(browser, file), f"report-{name}")
        with tempfile.TemporaryDirectory(prefix="servod-") as folder:
            for name, html in terminals(out / "pages", names, Path(folder)):
                save(terminal_picture(browser, html), f"terminal-{name}")
        browser.close()
    total = sum(file.stat().st_size for file in FOLDER.glob("*.png"))
    print(f"{FOLDER}: {total / 1e6:.2f} MB in all")
    return 1 if total > MOST_OF_ALL else 0


if __name__ == "__main__":
    sys.exit(main())
