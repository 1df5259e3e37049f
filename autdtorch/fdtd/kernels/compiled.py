"""Compilation of the CPU kernels by Numba, with results that do not depend on how it went."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

INNER: dict[str, Any] = {
    "error_model": "numpy",
    "nogil": True,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
"""Options of functions that compiled functions call: no wrappers for Python, no tests for division by zero.

`fastmath` must stay off in them. It lets the compiler reorder sums, otherwise in each function that a call is
inlined into: a kernel loaded from disk then rounds otherwise than the one just compiled."""


def entry(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and keep its machine code on disk.

    Numba compares the file of the function with the one that was compiled, but not the files of the functions
    that it calls. The digest in the name covers all of this folder, where these must be.

    Args:
        **options: of Numba, beside these.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        function.__qualname__ += f"_{_SOURCE}"
        return njit(cache=True, nogil=True, error_model="numpy", **options)(function)

    return compiled


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


_SOURCE = _digest(Path(__file__).parent)
