"""Compiles the kernels: the same plain functions that the loop calls, turned to machine code by numba when installed.

Off the control path (simulator, identification, synthesis, diagnosis, virtual plant). The kernels carry no decorator:
`compiled` copies a function, swaps every servod function that it calls for its compiled twin, and compiles the copy.
Machine code is cached per user in a folder named by the kernels' source and the machine, so that a change anywhere in
a kernel, or a new numba, compiles again (numba by itself watches only the calling file).
"""

from __future__ import annotations

import ctypes
import dis
import hashlib
import inspect
import os
import types
from collections.abc import Callable
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from servod.common.files import write_atomically

Kernel = Callable[..., Any]


@cache
def available() -> bool:
    """Whether kernels can be compiled here (numba is installed and not switched off by SERVOD_PURE_PYTHON=1)."""
    if os.environ.get("SERVOD_PURE_PYTHON") == "1":
        return False
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True


def compiled(function: Kernel, **swap: Kernel) -> Kernel:
    """`function` as machine code, with the functions it calls; `swap` replaces names that it looks up.

    Sequences must then be float64 arrays (`arrays`) and states records (`record`). Give functions that call a control
    law the law by `swap`.
    """
    return _compiled(function, tuple(sorted(swap.items(), key=lambda item: item[0])))


class Record(NamedTuple):
    """One memory, seen from both sides: `names` for Python, `memory`, a numpy array of one, for a compiled kernel."""

    names: Any
    memory: Any


def record(values: Any) -> Record:
    """A NamedTuple or dataclass of numbers as a record of the same names and values, which a kernel may change.

    A field may be such a NamedTuple or dataclass, too.
    """
    import numpy as np

    kind: object = type(values)
    structure, dtype, members = _structure(kind)
    names: Any = structure(*members(values))
    return Record(names, np.frombuffer(names, dtype=dtype))


class _Structure(NamedTuple):
    """The C structure of a class of numbers; its one dtype, for numba compares another that is equal at every call; and
    what gives the values of an instance as ctypes takes them.
    """

    fields: type[ctypes.Structure]
    dtype: Any
    members: Callable[[Any], tuple[Any, ...]]


@cache
def _structure(kind: object) -> _Structure:
    import numpy as np

    types = {float: ctypes.c_double, int: ctypes.c_int64, bool: ctypes.c_bool}
    hints = get_type_hints(kind)
    within = {name: _structure(hint) for name, hint in hints.items() if hint not in types}
    fields = [(name, within[name].fields if name in within else types[hint]) for name, hint in hints.items()]
    structure = type("Fields", (ctypes.Structure,), {"_fields_": fields})
    plain = attrgetter(*hints)

    def members(values: Any) -> tuple[Any, ...]:
        parts = zip(hints, plain(values), strict=True)
        return tuple(within[name].members(part) if name in within else part for name, part in parts)

    return _Structure(structure, np.dtype(structure), members if within else plain)


def entry(function: Kernel) -> Kernel:
    """`function(p, tables, s, ...)` compiled, to be called from Python as `entered`."""
    return compiled(entered, kernel=function)


def entry_without_lock(function: Kernel) -> Kernel:
    """`entry`, and the interpreter's lock is let go while the kernel runs: for threads."""
    return _compiled(entered, (("kernel", function),), without_lock=True)


def kernel(p: Any, tables: Any, s: Any, *rest: Any) -> None:
    """Nothing; `entry` puts the kernel that shall run in this function's place."""


def entered(axis: Any, tables: Any, *rest: Any) -> Any:
    """Call the kernel with p and s out of one record in an array of one: numba takes that in 0.15 us, a bare one in 13.

    Two records would take twice as long.
    """
    return kernel(axis[0].p, tables, axis[0].s, *rest)


def arrays(parameters: Any) -> Any:
    """A NamedTuple of numbers with every plain tuple in it a float64 array, as a compiled kernel takes it."""
    import numpy as np

    if not isinstance(parameters, tuple):
        return parameters
    if not hasattr(parameters, "_fields"):
        return np.array(parameters, dtype=np.float64)
    return type(parameters)(*map(arrays, parameters))


def bound(function: Kernel, **swap: Kernel) -> Kernel:
    """`function` in pure Python with names that it looks up replaced by `swap`; for machines without numba."""
    return types.FunctionType(
        function.__code__, {**function.__globals__, **swap}, function.__name__, function.__defaults__
    )


@cache
def _compiled(function: Kernel, swap: tuple[tuple[str, Kernel], ...], without_lock: bool = False) -> Kernel:
    import numba
    from numba.core import config as numba_config

    config: Any = numba_config
    njit: Any = numba.njit  # its stubs do not know _nrt

    called = {name: compiled(callee) for name, callee in {**_callees(function), **dict(swap)}.items()}
    copy, own = bound(function, **called), _cache_folder(function, swap, without_lock)
    copy.__code__ = copy.__code__.replace(co_filename=str(_source_in(own, Path(inspect.getfile(function)))))
    folder = config.CACHE_DIR
    config.CACHE_DIR = str(own)
    try:
        # no kernel makes an array, so none needs numba's counting of references: it took two thirds of the time
        kernel: Kernel = njit(cache=True, error_model="numpy", _nrt=False, nogil=without_lock)(copy)
    finally:
        config.CACHE_DIR = folder
    return kernel


def _callees(function: Kernel) -> dict[str, Kernel]:
    """The servod functions that `function` looks up by name; a parameter may have the name of one (`p.ripple`)."""
    found: dict[str, Kernel] = {}
    for name in {step.argval for step in dis.get_instructions(function) if step.opname == "LOAD_GLOBAL"}:
        value = function.__globals__.get(name)
        if isinstance(value, types.FunctionType) and value.__module__.split(".")[0] == "servod":
            found[name] = value
    return found


def _sources(function: Kernel) -> set[Path]:
    """The files in which `function` and all that it calls stand."""
    files = {Path(inspect.getfile(function))}
    for callee in _callees(function).values():
        files |= _sources(callee)
    return files


def _cache_folder(function: Kernel, swap: tuple[tuple[str, Kernel], ...], without_lock: bool) -> Path:
    digest = hashlib.sha256(b"without lock" if without_lock else b"")
    files = set(_sources(function))
    for name, callee in swap:
        files |= _sources(callee)
        digest.update(f"{name}={callee.__module__}.{callee.__qualname__}".encode())
    layout = Path(__file__).with_name("layout.py")
    for path in sorted({*files, layout, Path(__file__)}):
        digest.update(path.read_bytes())
    return _user_cache() / f"{function.__name__}-{digest.hexdigest()[:16]}"


def _source_in(folder: Path, source: Path) -> Path:
    """A copy of the file beside its machine code, which numba finds again by this path: so every installation of the
    same source finds it. Where nothing can be written, the file itself."""
    copy = folder / source.name
    try:
        if not copy.exists():
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(copy, source.read_text(encoding="utf-8"))
    except OSError:
        return source
    return copy


def _user_cache() -> Path:
    """A folder that this user may write: XDG cache, else one under the temporary folder."""
    import tempfile

    who = str(os.getuid()) if hasattr(os, "getuid") else "own"  # Windows gives each user a temporary folder
    other = Path(tempfile.gettempdir()) / f"servod-kernels-{who}"
    wanted = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "servod" / "kernels"
    try:
        wanted.mkdir(parents=True, exist_ok=True)
    except OSError:
        return other
    return wanted if os.access(wanted, os.W_OK) else other
