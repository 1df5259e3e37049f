"""Files that are written whole or not at all, errors that name them, locks, and NumPy files."""

from __future__ import annotations

import contextlib
import math
import os
import time
import tokenize
import uuid
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from numpy.lib import format as npy

from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.values import within

PARTIAL = ".partial"  # suffix of a file that is being written
ABANDONED = 3600.0  # age [s] after which a killed writer's partial file is removed; writing takes seconds


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path to an `OSError` that has none, such as the error of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def in_folder(path: Path) -> Path:
    """Return the path of a file that is to be written, after making its folder if that is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary name to write a file under, and rename it to `path` when it is complete.

    Readers find the old file or the new one, never a part of it, also if several processes write it at once.
    The folder is made if it is missing. The partial files that killed writers left in the folder are removed.
    """
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}{PARTIAL}")
    with naming(path):
        _remove_abandoned(in_folder(path).parent)
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())  # or a power failure could leave the name without the content
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def replace_file(path: Path, content: bytes) -> None:
    """Write a file as `replacing` does."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def _remove_abandoned(folder: Path) -> None:
    for path in folder.glob(f"?*.{'[0-9a-f]' * 32}{PARTIAL}"):
        with contextlib.suppress(OSError):  # another process removes it too, or another user owns it
            if time.time() - path.lstat().st_mtime > ABANDONED:
                path.unlink()


@contextlib.contextmanager
def held(lock: FileLock, refusal: Exception) -> Iterator[None]:
    """Hold a lock, acquired at once, or raise `refusal`; the system frees it however the process ends."""
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise refusal from error
    try:
        yield
    finally:
        lock.release()


_LARGEST = 2**30  # [bytes] of unpacked arrays; a small file can hold many zeros
_LONGEST_HEADER = 1000  # [bytes]; NumPy writes 128 for plain arrays
_PLAIN = "biufcU"  # kinds of dtype: numbers and text

# Errors of NumPy and zipfile for damaged files.
_DAMAGE = (OSError, ValueError, TypeError, LookupError, EOFError, OverflowError, RuntimeError, SyntaxError)
_ARCHIVE_DAMAGE = (tokenize.TokenError, zipfile.BadZipFile, zlib.error)

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by name to a .npz file, which is replaced."""
    with replacing(path) as partial, partial.open("wb") as file:  # to a path, NumPy would add .npz
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_arrays(path: str | os.PathLike[str]) -> dict[str, AnyArray]:
    """Read the arrays of a .npz file by name; the array of a .npy file has the name ""."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"{os.fspath(path)}: there is no such file")
    try:
        if not zipfile.is_zipfile(path):
            with Path(path).open("rb") as file:
                return {"": _read(file, Path(path).stat().st_size)}
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if (size := sum(member.file_size for member in members)) > _LARGEST:
                raise ValueError(f"{size} bytes, more than {_LARGEST}")
            arrays = {}
            for member in members:
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as file, within(name):
                    arrays[name] = _read(file, member.file_size)
            return arrays
    except (*_DAMAGE, *_ARCHIVE_DAMAGE) as error:
        raise ValueError(f"{os.fspath(path)}: {error}; must hold plain NumPy arrays") from error


def _read(file: Any, size: int) -> AnyArray:
    """Read the array of a file of `size` bytes."""
    version = npy.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"format {version} of an array; must be 1.0 or 2.0")
    shape, _, dtype = _HEADERS[version](file, max_header_size=_LONGEST_HEADER)
    if dtype.kind not in _PLAIN or file.tell() + math.prod(shape) * dtype.itemsize != size:
        raise ValueError(f"array of shape {shape} and type {dtype} in {size} bytes")
    file.seek(0)
    return np.asarray(npy.read_array(file, allow_pickle=False))
