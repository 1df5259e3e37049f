"""Compilation of the CPU kernels by Numba, with the same results from a cold and a warm cache."""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import io
import logging
import math
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from numba import njit
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.runtime.nrt import rtsys
from numba.core.typed_passes import AnnotateTypes

from autdtorch.utils.process import hold_at_fork, thread_count

logger = logging.getLogger(__name__)

_entries: set[Any] = set()
# See `meanwhile`; of all threads, because a thread of `spread` may be the first to compile
_ahead: list[_Ahead] = []
_children: dict[int, Any] = {}  # processes that compile, and the kernel
_PATIENCE = 30.0  # [s] without processor time after which processes that compile are taken to hang
_POLL = 0.01  # [s] between looks at them


class _InnerLibrary(JITCodeLibrary):
    """The code of a function that compiled functions call: linked into theirs, and optimised there.

    Numba would also optimise each alone and make machine code of it, which nobody runs: 45 % of the time.
    """

    @property
    def codegen(self) -> _InnerLibrary:
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Do nothing: the function is not called from Python."""

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()  # type: ignore[no-untyped-call]
        return 0

    def _optimize_final_module(self) -> None:
        """Do nothing: the module of the entry is optimised, once."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True


@register_pass(mutates_CFG=False, analysis_only=True)  # type: ignore[no-untyped-call]
class _MakeLibrary(AnalysisPass):
    _name = "make_library"

    def __init__(self) -> None:  # abstract in numba
        super().__init__()  # type: ignore[no-untyped-call]

    def run_pass(self, state: Any) -> bool:
        codegen, name = state.targetctx.codegen(), state.func_id.func_qualname
        if state.targetctx.data_model_manager[state.return_type].contains_nrt_meminfo():
            raise TypeError(f"{name} returns an array, whose references its caller would count")
        state.library = _InnerLibrary(codegen, name)  # type: ignore[no-untyped-call]
        return False


class _InnerCompiler(CompilerBase):
    def define_pipelines(self) -> list[Any]:
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)  # type: ignore[no-untyped-call]
        passes.add_pass_after(_MakeLibrary, AnnotateTypes)
        passes.finalize()
        return [passes]


# Options of all functions: no checks of division by zero, and no wrapper for C, a tenth of the time.
# `fastmath` must stay off. It lets the compiler reorder sums, in a different way wherever a call is inlined:
# a kernel loaded from disk then rounds differently from the one just compiled.
_OPTIONS: Any = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
# Options of functions that make and return no array: references to arrays are not counted.
NO_ARRAYS: Any = {"_nrt": False}
# Options of functions that compiled functions call: no wrapper for Python either.
INNER: Any = {**_OPTIONS, **NO_ARRAYS, "no_cpython_wrapper": True, "pipeline_class": _InnerCompiler}


class _Ahead(NamedTuple):
    kernel: Any
    call: Callable[[], object]  # compiles it
    others: tuple[Callable[[], object], ...]  # compile others


class _Compilation(event.Listener):
    """Logs that a kernel is compiled here, which takes seconds; loading one from disk takes none.

    Garbage collection is paused, an eighth of the time.
    """

    def __init__(self) -> None:
        self._paused = False
        self._others: list[Callable[[], object]] = []  # that follow what is compiled now

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"]
        if function in _entries:
            _log_compilation(function)
            self._paused = gc.isenabled()
            gc.disable()
            with contextlib.suppress(IndexError):  # no more
                while not isinstance(function._cache, NullCache):  # another process could save nothing
                    ahead = _ahead.pop()
                    if function is not ahead.kernel and _fork(ahead):
                        self._others.extend(ahead.others)

    def on_end(self, event: Any) -> None:
        if event.data["dispatcher"] not in _entries:
            return
        if self._paused:
            gc.enable()
        others, self._others = self._others, []
        for call in others:
            call()


event.register("numba:compile", _Compilation())  # type: ignore[no-untyped-call]
hold_at_fork(global_compiler_lock)


@contextlib.contextmanager
def meanwhile(kernel: Any, call: Callable[[], object], *others: Callable[[], object]) -> Iterator[None]:
    """Make a call in a process of its own as soon as another kernel is compiled here, so that its is too.

    That process writes the kernel to disk, from where this process loads it. The calls of `others` follow
    here at once, as their kernels share functions with the one that was compiled. Without a fork or a second
    processor, kernels are compiled here when they are needed.
    """
    ahead = _Ahead(kernel, call, others)
    if sys.platform == "linux" and thread_count() > 1:
        _ahead.append(ahead)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # made
            _ahead.remove(ahead)
        _forget_ended()


def _fork(ahead: _Ahead) -> bool:
    """Return whether another process compiles a kernel, also one that began before."""
    if _compiling(_index_of(ahead.kernel)):
        return True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of other threads: see utils/process.py
        try:
            child = os.fork()
        except OSError:  # too many processes, or too little memory: this one compiles
            return False
    if child:
        _children[child] = ahead.kernel
        return True
    try:
        _ahead.clear()
        _children.clear()
        logging.disable()
        ahead.call()
    finally:
        os._exit(0)


def _wait_for_children(index: str) -> None:
    """Wait until no other process compiles the kernel with these files, and log that one does."""
    worked, end = -1.0, math.inf
    _forget_ended()
    for kernel in _compiling(index).values():
        _log_compilation(kernel)
    while children := _compiling(index):
        time.sleep(_POLL)
        if (seconds := sum(map(_processor_seconds, children))) != worked:
            worked, end = seconds, time.monotonic() + _PATIENCE
        elif time.monotonic() > end:
            for child in children:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
        _forget_ended()


def _compiling(index: str) -> dict[int, Any]:
    """Return the processes that compile the kernel with these files, and the kernel."""
    return {child: kernel for child, kernel in tuple(_children.items()) if _index_of(kernel) == index}


def _index_of(kernel: Any) -> str:
    return str(kernel._cache._cache_file._index_path)


def _log_compilation(kernel: Any) -> None:
    logger.info("compiling %s (once per machine)", kernel.__name__)


def _processor_seconds(child: int) -> float:
    """Return the processor time [s] of a process, 0 once it has ended; see `clock_getcpuclockid` of Linux."""
    try:
        return time.clock_gettime(~child << 3 | 2)
    except OSError:
        return 0.0


def _forget_ended() -> None:
    for child in tuple(_children):
        try:
            ended = os.waitpid(child, os.WNOHANG) != (0, 0)
        except ChildProcessError:  # another thread has waited for it
            ended = True
        if ended:
            _children.pop(child, None)  # or another thread has removed it


class _Cache(FunctionCache):
    """Numba's cache of a kernel, which loads it without what only a compilation needs: 0.2 s."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


class _CheckedFiles(IndexDataCacheFile):
    """Numba's files of a kernel with a checksum at their ends, which pickle ignores, named by their content.

    Numba would run files that a crash or a full disk has cut off. Such files are compiled again. Numba also
    numbers files, and two processes could write kernels of two dtypes to one.
    """

    def load(self, key: Any) -> Any:
        _wait_for_children(self._index_path)
        return super().load(key)  # type: ignore[no-untyped-call]

    def save(self, key: Any, data: Any) -> None:
        number = int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:8])
        name = self._data_name(number)  # type: ignore[no-untyped-call]
        self._save_data(name, data)  # type: ignore[no-untyped-call]
        self._save_index(self._load_index() | {key: name})  # type: ignore[no-untyped-call]

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


def entry(*others: Path, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and cache its machine code on disk.

    Numba checks the file of the function for changes, but not the files of the functions that it calls. The
    digest in the name covers its folder and `others`, which must hold them.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        function.__qualname__ += f"_{_digest(Path(function.__code__.co_filename).parent, *others)}"
        try:
            dispatcher = njit(cache=True, **_OPTIONS, **options)(function)
            dispatcher._cache.__class__ = _Cache
            dispatcher._cache._cache_file.__class__ = _CheckedFiles
        except RuntimeError as error:  # no folder to write to
            _log_once(f"kernels are compiled in every process, 10 to 30 s: {error}")
            dispatcher = njit(**_OPTIONS, **options)(function)
        _entries.add(dispatcher)
        return dispatcher

    return compiled


@functools.cache
def _log_once(message: str) -> None:
    logger.warning("%s", message)


@functools.cache
def _digest(*folders: Path) -> str:
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for source in (source for folder in folders for source in sorted(folder.glob("*.py"))):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
