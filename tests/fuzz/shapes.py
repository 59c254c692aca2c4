"""Inputs that are nearly good: strategies that change good files, tables, frames and requests where it hurts."""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from typing import Any

import yaml
from hypothesis import strategies as st

from servod.common.yaml import parse_yaml

#: Numbers at which something might turn over.
ODD_NUMBERS: tuple[Any, ...] = (
    *(0, -0.0, -1, 1, 2, 127, 128, 255, 256, 32767, 65535, 65536, 2**31, 2**32, 2**53, 2**63, 2**64, -(2**63), 10**40),
    *(1e-320, 1e-300, 1e-9, 1e9, 1e38, 1e154, 1e300, 1.7e308, float("inf"), float("-inf"), float("nan"), 10**400),
)
#: Texts that have meant something to some reader.
ODD_TEXTS: tuple[str, ...] = (
    *(
        "",
        " ",
        "~",
        "on",
        "1e-3",
        "0x",
        "0o8",
        "1_000",
        ".inf",
        "\0",
        "\x1b[31m",
        "a\nb",
        "ä" * 40,
        "\u202e",
        "\U0001f4a5",
    ),
    *("../../../etc/passwd", "/dev/zero", "/proc/self/mem", "x" * 5000, "%s%n", "{0}", "`id`", "=cmd()", "<script>"),
)
odd_values = st.one_of(
    st.sampled_from(ODD_NUMBERS),
    st.sampled_from(ODD_TEXTS),
    st.none(),
    st.booleans(),
    st.floats(),
    st.integers(),
    st.just([]),
    st.just({}),
    st.lists(st.floats(), max_size=3),
    st.dictionaries(st.sampled_from(("kind", "law", "name", "x")), st.integers(), max_size=2),
)
#: What no plain document contains: aliases, tags, bombs, nesting, broken ends.
YAML_TRICKS: tuple[str, ...] = (
    *("&a [*a]", "&a {x: *a}", "!!python/object/apply:os.system ['id']", "!!timestamp x", "!!bool maybe", "!!int ''"),
    *(
        "!!binary x",
        "!!set {a, b}",
        "!!omap [a: 1]",
        "!!float x",
        "!!null x",
        "<<: {a: 1}",
        "? [a]\n: b",
        "? {a: b}\n: c",
    ),
    *("[" * 400, "{a: " * 400, "- " * 400, "0x" + "f" * 5000, "9" * 5000, "1e" + "9" * 50, '"\\ud800"', '"\\x00"'),
    *(
        "\t",
        "%YAML 9.9\n---",
        "--- a\n--- b",
        "*unknown",
        "a: 1\na: 2",
        "\ufeff",
        "# " + "c" * 3000,
        "'",
        "|\n  x",
        "@",
    ),
    "a: &a [x,x,x,x,x,x,x,x,x]\n"
    + "\n".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
)


@st.composite
def mutated(draw: st.DrawFn, seeds: Sequence[bytes], words: Sequence[bytes] = ()) -> bytes:
    """A good input with a few spans cut, doubled, overwritten or filled with words."""
    data = draw(st.sampled_from(list(seeds)))
    pieces = st.one_of(st.binary(max_size=16), st.sampled_from([b"", b"\0" * 8, b"\xff" * 8, *words]))
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.integers(0, len(data)))
        length = draw(st.sampled_from((0, 0, 1, 1, 2, 4, 8, 64, 1000)))
        piece = data[at : at + length] * 2 if draw(st.booleans()) else draw(pieces)
        data = data[:at] + piece + data[at + length :]
    return data[: draw(st.integers(0, len(data)))] if draw(st.integers(0, 9)) == 0 else data


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path of every value in a document."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, item in items for place in _places(item, (*path, key)))]


def _change(draw: st.DrawFn, document: Any) -> Any:
    """The document with one value replaced, removed, renamed or doubled."""
    path = draw(st.sampled_from(_places(document)))
    if not path:
        return draw(odd_values) if draw(st.integers(0, 9)) == 0 else document
    here = document
    for part in path[:-1]:
        here = here[part]
    how, last = draw(st.integers(0, 5)), path[-1]
    if how == 0:
        del here[last]
    elif how == 1 and isinstance(here, dict):
        here[draw(st.sampled_from(ODD_TEXTS))] = here[last]
    elif how == 2 and isinstance(here, list):
        here.extend([copy.deepcopy(here[last])] * draw(st.sampled_from((1, 20, 300))))
    else:
        here[last] = draw(odd_values)
    return document


@st.composite
def yaml_texts(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """A good YAML file with some values changed, and now and then a trick of the language in a place of it."""
    documents = [parse_yaml(seed.decode(), "seed") for seed in seeds]
    document = copy.deepcopy(draw(st.sampled_from(documents)))
    for _ in range(draw(st.integers(0, 4))):
        document = _change(draw, document)
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=draw(st.booleans()))
    if draw(st.integers(0, 2)) == 0:
        lines = text.splitlines() or [""]
        at = draw(st.integers(0, len(lines) - 1))
        key, colon, _ = lines[at].partition(": ")
        trick = draw(st.sampled_from(YAML_TRICKS))
        lines[at] = f"{key}{colon}{trick}" if draw(st.booleans()) else trick
        text = "\n".join(lines)
    return text.encode("utf-8", "surrogatepass")


cells = st.one_of(
    st.floats().map(repr),
    st.sampled_from([str(n) for n in ODD_NUMBERS]),
    st.sampled_from([*ODD_TEXTS, "1,5", '"', '"1"', "NaN", "true", "2026-01-01", "00:00:01", "1.0e+", "--1"]),
    st.integers(-3, 3).map(lambda n: str(n * 1e-3)),
)


@st.composite
def csv_texts(draw: st.DrawFn, names: Sequence[str]) -> bytes:
    """A table with good and foreign columns, time that mostly runs, and odd cells."""
    header = draw(st.lists(st.sampled_from([*names, "x", "t", ""]), min_size=1, max_size=6))
    if draw(st.integers(0, 3)):
        header = [*names[:3], *header]
    separator = draw(st.sampled_from((",", ",", ",", ";", "\t")))
    step_s = draw(st.sampled_from((1e-3, 1e-3, 1.0, 1e-12, 1e-300, 1e300, 0.0, -1e-3)))
    rows = [[repr(k * step_s), *(repr(0.01 * (k % 7)) for _ in header[1:])] for k in range(draw(st.integers(0, 40)))]
    for _ in range(draw(st.integers(0, 5)) if rows else 0):
        row = draw(st.sampled_from(rows))
        row[draw(st.integers(0, len(row) - 1))] = draw(cells)
    lines = [separator.join(header), *(separator.join(row) for row in rows)]
    return draw(st.sampled_from(("\n", "\n", "\r\n", "\r"))).join(lines).encode("utf-8", "surrogatepass")


def frame_lists(ids: Sequence[int], payloads: Sequence[bytes] = ()) -> st.SearchStrategy[bytes]:
    """Frames as the targets read them: an octet that chooses the identifier, one with the length, the data."""
    data = st.one_of(st.binary(max_size=8), st.sampled_from([b"", *payloads]))
    frame = st.tuples(st.integers(0, len(ids) - 1), data)
    return st.lists(frame, max_size=60).map(lambda fs: b"".join(bytes((n, len(d))) + d for n, d in fs))


@st.composite
def request_lines(draw: st.DrawFn, requests: Sequence[dict[str, Any]]) -> bytes:
    """Lines to the control socket: good requests with changed values, and lines that are none."""
    lines = []
    for _ in range(draw(st.integers(1, 6))):
        if draw(st.integers(0, 5)) == 0:
            lines.append(draw(st.one_of(st.binary(max_size=40), st.sampled_from(JSON_TRICKS))))
            continue
        request = copy.deepcopy(draw(st.sampled_from(list(requests))))
        for _ in range(draw(st.integers(0, 3))):
            request = _change(draw, request)
        lines.append(json.dumps(request).encode())
    return b"\n".join(lines) + draw(st.sampled_from((b"\n", b"", b"\r\n")))


JSON_TRICKS: tuple[bytes, ...] = (
    *(
        b"[" * 900,
        b'{"id":' * 900,
        b"null",
        b"[]",
        b"{}",
        b'"x"',
        b"\xff\xfe",
        b"\0",
        b" " * 5000,
        b'{"id": 1e999, "verb": 0}',
    ),
    *(b'{"id": NaN, "verb": "status"}', b'{"id": [[[]]], "verb": "status"}', b'{"verb": "status", "args": []}'),
    *(
        b'{"id": "\\ud800", "verb": "status"}',
        b'{"id": ' + b"9" * 4000 + b', "verb": "\\ud800"}',
        b'{"id": 1, "id": 2}',
    ),
)
