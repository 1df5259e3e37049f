"""Compilation of the CPU kernels by Numba, with results that do not depend on how it went."""

from __future__ import annotations

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


_entries: set[Any] = set()


class _Told(event.Listener):
    """Says in the log that a kernel is compiled, which takes seconds; to load one from disk takes none."""

    def on_start(self, event: Any) -> None:
        if event.data["dispatcher"] in _entries:
            logger.info("compiling a kernel (%s): once on a machine", event.data["dispatcher"].__name__)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Told())  # type: ignore[no-untyped-call]


def entry(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and keep its machine code on disk.

    Numba compares the file of the function with the one that was compiled, but not the files of the functions
    that it calls. The digest in the name covers all of this folder, where these must be.

    Args:
        **options: of Numba, beside these.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        function.__qualname__ += f"_{_SOURCE}"
        dispatcher = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
        _entries.add(dispatcher)
        return dispatcher

    return compiled


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


_SOURCE = _digest(Path(__file__).parent)
