"""Compilation of the CPU kernels by Numba, with the same results from a cold and a warm cache."""

from __future__ import annotations

import functools
import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import event

logger = logging.getLogger(__name__)

# Options of functions that compiled functions call: no wrappers for Python, no checks of division by zero.
# `fastmath` must stay off. It lets the compiler reorder sums, in a different way wherever a call is inlined:
# a kernel loaded from disk then rounds differently from the one just compiled.
INNER: Any = {"error_model": "numpy", "nogil": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

_HERE = Path(__file__).parent
_entries: set[Any] = set()


class _CompilationLog(event.Listener):
    """Logs that a kernel is compiled, which takes seconds; loading one from disk takes none."""

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"]
        if function in _entries:
            logger.info("compiling %s (once per machine)", function.__name__)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _CompilationLog())  # type: ignore[no-untyped-call]


def entry(folder: Path = _HERE, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and cache its machine code on disk.

    Numba checks the file of the function for changes, but not the files of the functions that it calls. The
    digest in the name covers a whole folder, which must hold them.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        function.__qualname__ += f"_{_digest(folder)}"
        dispatcher = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
        _entries.add(dispatcher)
        return dispatcher

    return compiled


@functools.cache
def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
