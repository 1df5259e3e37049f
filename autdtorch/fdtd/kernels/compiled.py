"""Compilation of the CPU kernels by Numba, with the same results from a cold and a warm cache."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import event
from numba.core.caching import IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock

from autdtorch.utils.process import hold_at_fork

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
hold_at_fork(global_compiler_lock)


class _CheckedFiles(IndexDataCacheFile):
    """Numba's files of a kernel with a checksum at their ends, which pickle ignores.

    Numba would run files that a crash or a full disk has cut off. Such files are compiled again.
    """

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        with super()._open_for_write(filepath) as file:
            content = io.BytesIO()
            yield content
            file.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())

    def _load_index(self) -> Any:
        path = Path(self._index_path)
        readable = not path.exists() or _is_whole(path)
        return super()._load_index() if readable else {}  # type: ignore[no-untyped-call]

    def _load_data(self, name: str) -> Any:
        path = Path(self._data_path(name))  # type: ignore[no-untyped-call]
        if not _is_whole(path):
            raise OSError(f"{path} is not whole")  # numba compiles again
        return super()._load_data(name)  # type: ignore[no-untyped-call]


def _is_whole(path: Path) -> bool:
    """Return whether a file ends with the checksum of the rest; log if it does not."""
    content = path.read_bytes()
    size = hashlib.sha256().digest_size
    whole = hashlib.sha256(content[:-size]).digest() == content[-size:]
    if not whole:
        logger.warning("%s is not whole: compiling again", path)
    return whole


def entry(folder: Path = _HERE, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and cache its machine code on disk.

    Numba checks the file of the function for changes, but not the files of the functions that it calls. The
    digest in the name covers a whole folder, which must hold them.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        function.__qualname__ += f"_{_digest(folder)}"
        try:
            dispatcher = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
            dispatcher._cache._cache_file.__class__ = _CheckedFiles
        except RuntimeError as error:  # no folder to write to
            _log_once(f"kernels are compiled in every process, 10 to 30 s: {error}")
            dispatcher = njit(nogil=True, error_model="numpy", **options)(function)
        _entries.add(dispatcher)
        return dispatcher

    return compiled


@functools.cache
def _log_once(message: str) -> None:
    logger.warning("%s", message)


@functools.cache
def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for source in sorted(folder.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
