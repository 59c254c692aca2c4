"""Move the fragments of changelog.d into CHANGELOG.md, as the section of one release.

    python scripts/changelog.py 0.2.0

Fragments are plain files SLUG.KIND.md (changelog.d/README.md). They are deleted; `--dry-run` only prints the section.
"""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FRAGMENTS, CHANGELOG = ROOT / "changelog.d", ROOT / "CHANGELOG.md"
KINDS = {"added": "Added", "changed": "Changed", "fixed": "Fixed", "removed": "Removed"}
MARK = "<!-- releases: newest first, written by scripts/changelog.py -->\n"


def fragments(folder: Path = FRAGMENTS) -> list[Path]:
    """Every fragment, by kind and name. Raises ValueError where a name says no kind or a text is empty."""
    found = []
    for file in folder.iterdir():
        if file.name == "README.md":
            continue
        slug, _, kind = file.name.removesuffix(".md").rpartition(".")
        if not (slug and file.suffix == ".md" and kind in KINDS):
            raise ValueError(f"{file.name}: found no kind, allowed SLUG.KIND.md with {', '.join(KINDS)}")
        if not file.read_text().strip():
            raise ValueError(f"{file.name}: found nothing, allowed a sentence")
        found.append((list(KINDS).index(kind), file.name, file))
    return [file for _, _, file in sorted(found)]


def section(version: str, day: str, files: list[Path]) -> str:
    """The section of one release."""
    lines = [f"## {version} ({day})\n"]
    for kind, title in KINDS.items():
        texts = [" ".join(f.read_text().split()) for f in files if f.name.endswith(f".{kind}.md")]
        if texts:
            lines.append(f"### {title}\n\n" + "\n".join(f"- {text}" for text in texts) + "\n")
    return "\n".join(lines)


def main() -> int:
    """Print the section, or write it and delete the fragments; 1 without a fragment, 2 where one is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("version", help="the release, e.g. 0.2.0")
    parser.add_argument("--dry-run", action="store_true", help="print, change nothing")
    options = parser.parse_args()
    try:
        files = fragments()
    except ValueError as error:
        print(f"changelog.d/{error}", file=sys.stderr)
        return 2
    if not files:
        print("changelog.d: no fragments", file=sys.stderr)
        return 1
    text = section(options.version, datetime.datetime.now(tz=datetime.UTC).date().isoformat(), files)
    if options.dry_run:
        print(text)
        return 0
    CHANGELOG.write_text(CHANGELOG.read_text().replace(MARK, f"{MARK}\n{text}", 1))
    for file in files:
        file.unlink()
    return 0


if __name__ == "__main__":
    sys.exit(main())
