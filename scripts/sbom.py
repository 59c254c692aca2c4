"""What is installed beside servod, as a software bill of materials (CycloneDX 1.5, JSON) on standard output.

    /opt/servod/bin/python scripts/sbom.py > servod.cdx.json

Reads the metadata of the Python that runs it, works without a network, and lists servod and all it needs, each with
version, licence, package URL and the hash of what was installed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from typing import Any

ROOT = "servod"
_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9._-]*")


def normal(name: str) -> str:
    """A project's name as package URLs have it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def needed(name: str, seen: set[str]) -> Iterator[Distribution]:
    """The distribution and those it needs, without extras, once each; what is not installed is not needed here."""
    if normal(name) in seen:
        return
    seen.add(normal(name))
    try:
        found = distribution(name)
    except PackageNotFoundError:
        return
    yield found
    for requirement in found.requires or ():
        if "extra ==" not in requirement and (match := _NAME.match(requirement)):
            yield from needed(match[0], seen)


def component(found: Distribution) -> dict[str, Any]:
    """One entry; the hash is of the list of installed files, which holds the hash of each (PEP 376, RECORD)."""
    name, version = normal(found.metadata["Name"]), found.version
    record = found.read_text("RECORD") or ""
    purl = f"pkg:pypi/{name}@{version}"
    entry: dict[str, Any] = {"type": "library", "bom-ref": purl, "name": name, "version": version, "purl": purl}
    entry["properties"] = [{"name": "record-sha256", "value": hashlib.sha256(record.encode()).hexdigest()}]
    if licence := found.metadata.get("License-Expression") or found.metadata.get("License"):
        entry["licenses"] = [{"license": {"name": licence.splitlines()[0]}}]
    return entry


def document() -> dict[str, Any]:
    """The whole bill."""
    components = [component(found) for found in needed(ROOT, set())]
    if not components:
        sys.exit(f"sbom: {ROOT} is not installed for {sys.executable}")
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": components[0] | {"type": "application"}},
        "components": sorted(components[1:], key=lambda c: str(c["name"])),
    }


def main() -> None:
    """Print the bill; one line on standard error when nobody takes it."""
    text = json.dumps(document(), indent=2)
    try:
        print(text, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter flushes once more
        sys.exit(f"sbom: standard output: {error.strerror}")


if __name__ == "__main__":
    main()
