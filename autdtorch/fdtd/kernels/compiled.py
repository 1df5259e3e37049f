"""Compilation of the CPU kernels by Numba, with results that do not depend on how it went."""

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

INNER: dict[str, Any] = {
    "error_model": "numpy",
    "nogil": True,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
"""Options of functions that compiled functions call: no wrappers for Python, no tests for division by zero.

`fastmath` must stay off in them. It lets the compiler reorder sums, otherwise in each function that a call is
inlined into: a kernel loaded from disk then rounds otherwise than the one just compiled."""


_HERE = Path(__file__).parent

_entries: set[Any] = set()


class _Told(event.Listener):
    """Says in the log that a kernel is compiled, which takes seconds; to load one from disk takes none."""

    def __init__(self) -> None:
        self._inside = 0

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"]
        if function in _entries and not self._inside:
            logger.info("compiling %s: once on a machine", function.__name__)
        self._inside += 1

    def on_end(self, event: Any) -> None:
        self._inside -= 1


event.register("numba:compile", _Told())  # type: ignore[no-untyped-call]


def entry(folder: Path = _HERE, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and keep its machine code on disk.

    Numba compares the file of the function with the one that was compiled, but not the files of the functions
    that it calls. The digest in the name covers all of a folder, where these must be.

    Args:
        folder: of the function.
        **options: of Numba, beside these.
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
