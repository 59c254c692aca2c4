"""Looks at every report in Chromium, and says what a person would complain of.

    scripts/browser                        make every page, look at it on desk, phone and paper, in light and dark
    scripts/browser demo plot --keep       these two alone, as they were made before

A page is looked at 1440 px wide in light and then, without loading it again, in dark; 390 px wide as a phone in dark
and then in light; and on paper. Findings: text below 12 px, a page that scrolls sideways, what axe-core calls serious
or critical, text or curves that do not stand out from what is behind them, labels cut or upon one another, errors of
the page, requests to the network, what paper would cut, a fast sine that does not zoom into a sine, pictures that do
not move together, figures in a caption that stand nowhere else. Exit code 1 when there is one. Pictures of each look
lie in --out.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from axe_playwright_python.sync_playwright import Axe
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from tests.browser import reports
from tests.browser.zoom import linked, sine

DESK, PHONE = {"width": 1440, "height": 900}, {"width": 390, "height": 844}
#: What paper of A4 leaves of its 210 by 297 mm at 96 px an inch, with Chromium's usual margins of 1 cm.
PAPER = {"width": 718, "height": 1047}
LEAST_PX = 12.0
#: WCAG 2.2, 1.4.3 for text. Curves are told by legend and dashes too: they must be seen, 1.4.11 wants more of icons.
TEXT_CONTRAST, CURVE_CONTRAST = 4.5, 2.0
#: Chromium of Debian, of others, or as told.
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_MEASURE, _BAD_PAGE = (Path(__file__).parent / "measure.js").read_text(), Path(__file__).parent / "bad.html"
_NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?=\s?(?:mrad|mN·m|N·m|rad/s|dB|°|Hz|ms\b|%|cycles))")


@dataclass
class Look:
    """One look at a page: its figures, and what is wrong."""

    page: str
    view: str
    least_px: float = 0.0
    contrast: float = 0.0
    axe: int = 0
    found: list[str] = field(default_factory=list)

    def row(self) -> str:
        """For the table."""
        axe = "" if self.axe < 0 else str(self.axe)
        return (
            f"{self.page:<28} {self.view:<11} {self.least_px:>8.1f} {self.contrast:>9.1f} {axe:>4} {len(self.found):>9}"
        )


HEADER = f"{'page':<28} {'view':<11} {'least px':>8} {'contrast':>9} {'axe':>4} {'findings':>9}"


def looks(browser: Browser, file: Path, name: str, out: Path) -> Iterator[Look]:
    """All looks at one page; light and dark change while it is open, in either order."""
    for place, size, schemes in (("desk", DESK, ("light", "dark")), ("phone", PHONE, ("dark", "light"))):
        phone = place == "phone"
        context = browser.new_context(
            viewport=size, is_mobile=phone, has_touch=phone, color_scheme=schemes[0], device_scale_factor=1
        )
        with context:
            page = context.new_page()
            complaints = _listen(page)
            open_page(page, file)
            page.evaluate("document.querySelectorAll('details').forEach((e) => { e.open = true; })")
            for scheme in schemes:
                page.emulate_media(color_scheme=scheme)
                look = _look(page, Look(name, f"{place} {scheme}"), out, axe=True)
                look.found += _taken(complaints)
                yield look
            if place == "desk":
                page.emulate_media(media="print", color_scheme="dark")
                yield _paper(page, Look(name, "paper", axe=-1), out)
                page.emulate_media(media="screen", color_scheme="light")
                yield Look(name, "hand", axe=-1, found=[*linked(page), *_captions(page, file), *_taken(complaints)])


def _listen(page: Page) -> list[str]:
    """Errors of the page and what it asks of the network, as they come."""
    said: list[str] = []
    page.on("console", lambda message: said.append(f"console: {message.text}") if message.type == "error" else None)
    page.on("pageerror", lambda error: said.append(f"error: {error}"))
    page.on(
        "request", lambda r: None if r.url.startswith(("file:", "data:", "blob:")) else said.append(f"asks {r.url}")
    )
    return said


def _taken(said: list[str]) -> list[str]:
    taken = [line[:200] for line in said]
    said.clear()
    return taken


def open_page(page: Page, file: Path) -> None:
    """Open a report, and wait until its pictures are drawn."""
    page.goto(file.resolve().as_uri(), timeout=60_000)
    page.wait_for_function("window.servodReady === undefined || document.documentElement.dataset.ready", timeout=60_000)
    page.wait_for_timeout(300)


def _measured(page: Page) -> dict[str, Any]:
    """What measure.js finds. It comes as text: to hand some thousand boxes over one by one takes ten times as long."""
    found: dict[str, Any] = json.loads(page.evaluate(f"JSON.stringify(({_MEASURE})())"))
    return found


def _look(page: Page, look: Look, out: Path, axe: bool) -> Look:
    page.wait_for_timeout(300)
    seen = _measured(page)
    png = page.screenshot(full_page=True, timeout=60_000)
    (out / f"{look.page.replace('/', '_')}_{look.view.replace(' ', '_')}.png").write_bytes(png)
    look.least_px = min(text["px"] for text in seen["texts"])
    small = Counter(f"{t['px']:.1f} px: {t['where']} {t['text']!r}" for t in seen["texts"] if t["px"] < LEAST_PX - 0.01)
    look.found += _few(small)
    if seen["scroll"] > 0 or seen["phone"] < 0.99 or seen["width"] != page.viewport_size["width"]:
        look.found.append(f"scrolls sideways: {seen['scrolled']} px of {seen['width']}, by {', '.join(seen['wide'])}")
    image = Image.open(io.BytesIO(png)).convert("RGB")
    look.contrast, faint = _contrast(image, seen)
    look.found += [*_few(faint), *_few(Counter(_crowded(seen["texts"])))]
    look.found += _few(Counter(f"broken in a cell: {word}" for word in seen["broken"]))
    edge = _luminance(image.getpixel((1, 1)))
    if (edge > 0.2) if "dark" in look.view else (edge < 0.8):
        look.found.append("dark scheme, light page" if edge > 0.2 else "light scheme or paper, dark page")
    if axe:
        grave = [v for v in Axe().run(page).response["violations"] if v["impact"] in ("serious", "critical")]
        look.axe = len(grave)
        look.found += [f"axe: {v['id']}: {len(v['nodes'])} times, {v['nodes'][0]['target']}" for v in grave]
    return look


def _few(found: Counter[str], most: int = 6) -> list[str]:
    """The first of many findings of a kind."""
    lines = [f"{line} ({n} times)" if n > 1 else line for line, n in list(found.items())[:most]]
    return [*lines, f"and {len(found) - most} more like these"] if len(found) > most else lines


# --- Contrast ---------------------------------------------------------------------------------------------------------


def _contrast(image: Image.Image, seen: dict[str, Any]) -> tuple[float, Counter[str]]:
    """The least contrast of a text in pictures, which axe-core leaves out, and what stands out too little."""
    least, faint = 21.0, Counter[str]()
    for text in (text for text in seen["texts"] if text["svg"]):
        behind = _behind(image, text["box"])
        found = _ratio(_mixed(text["colour"], text["opacity"], behind), behind)
        least = min(least, found)
        if found < TEXT_CONTRAST - 0.05:
            faint[f"contrast {found:.1f}: {text['where']} {text['text']!r}"] += 1
    for line in seen["strokes"]:
        behind = image.getpixel((int(line["box"]["x"]) + 2, int(line["box"]["y"]) + 2))  # the corner of its picture
        found = _ratio(_mixed(line["colour"], 1.0, behind), behind)
        if found < CURVE_CONTRAST:
            faint[f"contrast {found:.1f}: curve {line['colour']} on {behind}, {line['where']}"] += 1
    return least, faint


def _behind(image: Image.Image, box: dict[str, float]) -> tuple[int, int, int]:
    """The commonest colour around a text or a curve."""
    left, top = max(int(box["x"]) - 3, 0), max(int(box["y"]) - 3, 0)
    part = image.crop((left, top, left + int(box["w"]) + 6, top + int(box["h"]) + 6))
    part = part.resize((min(part.width, 150), min(part.height, 150)), Image.Resampling.NEAREST)
    colours = part.getcolors(maxcolors=part.width * part.height) or [(1, (255, 255, 255))]
    return max(colours)[1]  # type: ignore[return-value]


def _mixed(css: str, opacity: float, behind: tuple[int, int, int]) -> tuple[float, ...]:
    numbers = [float(n) for n in re.findall(r"[\d.]+", css)]
    share = opacity * (numbers[3] if len(numbers) > 3 else 1.0)
    return tuple(share * c + (1.0 - share) * b for c, b in zip(numbers[:3], behind, strict=True))


def _luminance(colour: tuple[float, ...]) -> float:
    """Relative luminance (WCAG 2.2)."""
    linear = [(v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4) for v in (c / 255.0 for c in colour[:3])]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def _ratio(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    low, high = sorted((_luminance(a), _luminance(b)))
    return (high + 0.05) / (low + 0.05)


# --- Labels -----------------------------------------------------------------------------------------------------------


def _crowded(texts: list[dict[str, Any]]) -> Iterator[str]:
    """Labels of a picture that its edge cuts, and labels upon one another."""
    pictures: dict[int, list[dict[str, Any]]] = {}
    for text in (text for text in texts if text["svg"]):
        box, edge = text["box"], text["picture"]
        if box["x"] < edge["x"] - 2 or box["x"] + box["w"] > edge["x"] + edge["w"] + 2:
            yield f"cut by its picture: {text['where']} {text['text']!r}"
        pictures.setdefault(text["index"], []).append(text)
    for labels in pictures.values():
        for n, one in enumerate(labels):
            for other in labels[n + 1 :]:
                if _shared(one["box"], other["box"]) > 0.3:
                    yield f"upon one another: {one['where']} {one['text']!r} and {other['text']!r}"


def _shared(a: dict[str, float], b: dict[str, float]) -> float:
    """The part of the smaller box that the other covers."""
    width = min(a["x"] + a["w"], b["x"] + b["w"]) - max(a["x"], b["x"])
    height = min(a["y"] + a["h"], b["y"] + b["h"]) - max(a["y"], b["y"])
    return max(width, 0.0) * max(height, 0.0) / min(a["w"] * a["h"], b["w"] * b["h"])


# --- Paper and captions -----------------------------------------------------------------------------------------------


def _paper(page: Page, look: Look, out: Path) -> Look:
    """Print it, and look at the sheet: light, nothing wider than it, no picture or row that cannot stay whole."""
    page.set_viewport_size(PAPER)
    look = _look(page, look, out, axe=False)
    for part in _measured(page)["figures"]:
        held = part["inside"] in ("avoid", "avoid-page")
        low = part["kind"] == "figure" and part["height"] < PAPER["height"] / 2
        if not held and (part["kind"] in ("row", "panel") or low):
            look.found.append(f"paper may cut it: {part['kind']} {part['where']}")
        if part["kind"] in ("row", "panel") and part["height"] > PAPER["height"]:
            look.found.append(f"higher than paper: {part['kind']} {part['where']}, {part['height']:.0f} px")
    look.found = list(dict.fromkeys(look.found))
    page.pdf(path=out / f"{look.page.replace('/', '_')}.pdf", format="A4", print_background=True)
    page.set_viewport_size(DESK)
    return look


def _captions(page: Page, file: Path) -> Iterator[str]:
    """Each figure with a unit in a caption is one of the page's sentences and tables, or of the documents beside it."""
    seen = _measured(page)
    beside = [json.loads(found.read_text()) for found in sorted(file.parent.glob("*.json"))]
    known = {float(n) for n in re.findall(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", seen["outside"].replace("−", "-"))}
    known |= {scale * n for n in _numbers(beside) for scale in (1.0, 1e3, 1e-3, 100.0, 57.29577951308232)}
    for caption in seen["captions"]:
        for said in _NUMBER.findall(caption):
            digits = len(said.split("e")[0].lstrip("+-−").replace(".", "").lstrip("0")) or 1
            value = float(said.replace("−", "-"))
            if not any(abs(abs(n) - abs(value)) <= 0.51 * abs(value) * 10.0 ** (1 - digits) for n in known):
                yield f"only in a caption: {said} in {caption[:80]!r}"


def _numbers(document: Any) -> Iterator[float]:
    if isinstance(document, bool):
        return
    if isinstance(document, int | float):
        yield float(document)
    elif isinstance(document, dict | list):
        for part in document.values() if isinstance(document, dict) else document:
            yield from _numbers(part)


# --- The eye itself ---------------------------------------------------------------------------------------------------

#: What is wrong with bad.html: each of these must be seen, or nothing that is not seen elsewhere means anything.
_BAD = (
    *("8.0 px:", "scrolls sideways", "axe: color-contrast", "axe: image-alt", "axe: html-has-lang", "contrast 1.4"),
    *("curve rgb(238, 238, 238)", "cut by its picture", "upon one another", "broken in a cell: 29999"),
    *(
        "dark scheme, light page",
        "error: not caught",
        "asks https:",
        "paper may cut it: row",
        "only in a caption: 0.126",
    ),
)


def unseen(browser: Browser, out: Path) -> list[str]:
    """What is not found on a page that has everything."""
    seen = "\n".join(line for look in looks(browser, _BAD_PAGE, "bad", out) for line in look.found)
    return [f"not seen on {_BAD_PAGE.name}: {what}" for what in _BAD if what not in seen]


# --- The command ------------------------------------------------------------------------------------------------------


def chromium() -> str | None:
    """The browser's program, or None."""
    return os.environ.get("SERVOD_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)


def main() -> int:
    """Make, look, say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [report.name for report in reports.REPORTS]
    parser.add_argument("report", nargs="*", choices=[*known, []], help="which; all unless stated")
    parser.add_argument("--out", type=Path, default=Path("build/browser"), help="folder of pages and pictures")
    parser.add_argument("--keep", action="store_true", help="look at pages that were made before")
    parser.add_argument("--jobs", type=int, default=2, help="pages that are made at a time")
    told = parser.parse_args()
    program = chromium()
    if program is None:
        sys.exit(f"browser: none of {', '.join(BROWSERS)} is installed; on Debian: apt install chromium")
    pictures = told.out / "looks"
    pictures.mkdir(parents=True, exist_ok=True)
    begun_s, found = time.monotonic(), list[Look]()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"] if not os.getuid() else [])
        found.append(Look("bad", "eye", axe=-1, found=unseen(browser, pictures)))
        print("\n".join([HEADER, found[0].row(), *(f"    {line}" for line in found[0].found)]), flush=True)
        for file, error in reports.make(told.out / "pages", set(told.report), told.keep, told.jobs, quick=True):
            name = str(file.relative_to(told.out / "pages").with_suffix(""))
            for look in [Look(name, "not made", found=[error])] if error else looks(browser, file, name, pictures):
                found.append(look)
                print("\n".join([look.row(), *(f"    {line}" for line in look.found)]), flush=True)
        found.append(Look("plot/sine", "zoom", axe=-1, found=list(sine(browser, told.out / "pages/plot"))))
        print("\n".join([found[-1].row(), *(f"    {line}" for line in found[-1].found)]))
        browser.close()
    wrong = sum(len(look.found) for look in found)
    seconds = time.monotonic() - begun_s
    print(f"{wrong} findings in {len(found)} looks, {seconds:.0f} s; pictures: {pictures}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
