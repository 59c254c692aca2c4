"""A copy of the process for each of many trials that begin in the same state, which is dear to bring about."""

from __future__ import annotations

import os
from collections.abc import Callable


def forked(work: Callable[[], bytes]) -> bytes:
    """What `work` gives in a copy of this process, or the error that it raised; nothing changes here."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            answer = work()
        except BaseException as error:
            answer = repr(error).encode()
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(answer)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        answer = pipe.read()
    status = os.waitpid(pid, 0)[1]
    assert status == 0, f"the copy ended with {os.waitstatus_to_exitcode(status)}"
    return answer
