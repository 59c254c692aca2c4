"""Runs command lines one after the other in this process: their words from standard input, what came of each back.

What a platform lacks (sitecustomize.py) is asked of all of them by one start of Python.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys

from servod.cli.app import run


def said_by(words: list[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of one command line."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(words)
    return code, out.getvalue(), err.getvalue()


if __name__ == "__main__":
    print(json.dumps([said_by(words) for words in json.load(sys.stdin)]))
