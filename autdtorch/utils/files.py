"""Files: paths, locks, writing whole or not at all, NumPy files, and append-only files of JSON lines."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import logging
import math
import os
import re
import time
import tokenize
import uuid
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from numpy.lib import format as npy

from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.validation import invalid, within

logger = logging.getLogger(__name__)

PARTIAL = ".partial"  # suffix of a file that is being written
ABANDONED = 3600.0  # age [s] after which a killed writer's partial file is removed; writing takes seconds
_NAME = re.compile(r"(?!\.+$)[\w.+-]+")
_LONGEST_NAME = 100  # bytes


def require_name(field: str, name: object) -> None:
    """Check a name that becomes part of the names of files and HDF5 groups."""
    if not isinstance(name, str) or not _NAME.fullmatch(name) or len(name.encode()) > _LONGEST_NAME:
        accepted = "a name must be text of letters, digits and _ . + -, not of dots alone"
        raise invalid(field, name, f"{accepted}, with at most {_LONGEST_NAME} bytes")


def path_of(name: str, value: object, what: str = "a file", suffixes: Collection[str] = ()) -> Path:
    """Return `value` as the path of `what`, which ends in one of the `suffixes`, if any."""
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str) or not text or "\0" in text:
        raise invalid(name, value, f"must be the path of {what}")
    path = Path(text)
    if suffixes and not re.fullmatch(f".+({'|'.join(map(re.escape, suffixes))})", path.name.lower()):
        raise invalid(name, text, f"must end in one of {', '.join(suffixes)}")
    return path


def require_file(path: str | os.PathLike[str]) -> Path:
    """Return a path that has a file, or raise `FileNotFoundError` or `IsADirectoryError` with the fix."""
    file = Path(path)
    if file.is_dir():
        raise IsADirectoryError(f"{file}: a folder; must be a file")
    if not file.exists():
        begin = "" if file.is_absolute() else f"; the path starts from {Path.cwd()}"
        raise FileNotFoundError(f"{file}: there is no such file{begin}")
    return file


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
    require_file(path)
    try:
        if not zipfile.is_zipfile(path):
            with Path(path).open("rb") as file:
                if file.read(2) in (b"", b"PK"):  # PK begins an archive, whose end has its table
                    raise ValueError("empty or broken off")
                file.seek(0)
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
    version = npy.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"format {version} of an array; must be 1.0 or 2.0")
    shape, _, dtype = _HEADERS[version](file, max_header_size=_LONGEST_HEADER)
    if dtype.kind not in _PLAIN or file.tell() + math.prod(shape) * dtype.itemsize != size:
        raise ValueError(f"array of shape {shape} and type {dtype} in {size} bytes")
    file.seek(0)
    return np.asarray(npy.read_array(file, allow_pickle=False))


SET_ASIDE = ".damaged"  # suffix of the file, next to the first, that keeps the lines that cannot be used
_SEAM = re.compile(rb'(?=\{")|(?<="\})')  # possible start or end of a row without nested objects
_WRONG_CHECKSUM = "its checksum is wrong"
_BROKE_OFF = "the last line broke off"
_REFUSED_ROW = (ValueError, KeyError, TypeError, OverflowError, RuntimeError)  # errors of a refused row


def line_of(row: Mapping[str, Any], key: str = "") -> bytes:
    """Return a row as a line without newline; its last field is the checksum of the rest and the `key`."""
    return _with_checksum(json.dumps(row)[:-1].encode(), key)


def row_of(line: bytes, key: str = "") -> dict[str, Any]:
    """Return the row of a line made by `line_of`; nothing is parsed before the checksum is verified."""
    if not _is_whole(line, key):
        raise ValueError(_WRONG_CHECKSUM)
    row: dict[str, Any] = json.loads(line[:-_END] + b"}")
    return row


class JsonLines:
    """An append-only file of JSON objects, one per line; call `mend` before the first `append`.

    A row with a correct checksum is used even if the end of its line is damaged or missing.

    Attributes:
        used: number of rows that were read and accepted.
    """

    def __init__(
        self, path: Path, key: str, use: Callable[[dict[str, Any]], None], head: bytes = b""
    ) -> None:
        """Read the file if it exists, without changing it.

        The checksums of the lines include the `key`. `head` is the first line, with its newline. `use` is
        called with each row and refuses it by a `ValueError`, `KeyError` or `TypeError`.
        """
        content = path.read_bytes() if path.exists() else b""
        lines = content.removeprefix(head).split(b"\n")
        first = 2 if head and content.startswith(head) else 1
        good: list[bytes] = []
        self._refused: list[tuple[int, bytes, str]] = []
        for number, line in enumerate(lines, first):
            for part in _parts(line, key):
                try:
                    use(row_of(part, key))
                    good.append(part)
                except _REFUSED_ROW as error:
                    reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
                    broke_off = reason == _WRONG_CHECKSUM and number == first + len(lines) - 1
                    self._refused.append((number, part, _BROKE_OFF if broke_off else reason))
        self.used = len(good)
        self._path, self._key = path, key
        mended = head + b"".join(line + b"\n" for line in good)
        self._mended = None if content == mended else mended
        self._was_there, self._size = bool(content), len(mended)

    def mend(self) -> None:
        """Move damaged and refused lines to another file, and restore newlines and a missing head."""
        if self._mended is None:
            return
        path = self._path.with_name(self._path.name + SET_ASIDE)
        if self._refused:
            with naming(path), path.open("ab") as file:
                file.writelines(line + b"\n" for _, line, _ in self._refused)
                file.flush()
                os.fsync(file.fileno())
            numbers = list(dict.fromkeys(number for number, _, _ in self._refused))
            more = f" and {len(numbers) - 1} more" if len(numbers) > 1 else ""
            reasons = "; ".join(dict.fromkeys((self._refused[0][2], self._refused[-1][2])))
            logger.warning("%s, line %d%s: set aside in %s: %s", self._path, numbers[0], more, path, reasons)
        elif self._was_there:
            logger.warning("%s: the first line or an end of line was damaged: restored", self._path)
        replace_file(self._path, self._mended)
        self._mended = None

    def append(self, *rows: Mapping[str, Any]) -> None:
        """Append rows, which are on disk on return; after an error the file is unchanged."""
        rest = memoryview(b"".join(line_of(row, self._key) + b"\n" for row in rows))
        mode = "r+b" if self._size else "ab"  # "ab" would create a removed file again
        with naming(self._path), self._path.open(mode, buffering=0) as file:
            if file.seek(0, os.SEEK_END) != self._size:
                raise ValueError(f"{self._path}: has changed meanwhile; open it again, or give another file")
            try:
                while rest:
                    rest = rest[file.write(rest) :]
                os.fsync(file.fileno())
                self._size = file.tell()
            except BaseException:
                file.truncate(self._size)
                raise


def _parts(line: bytes, key: str) -> Iterator[bytes]:
    """Yield whole rows and the text between them of a line in which newlines were lost."""
    if _is_whole(line, key):
        yield line
        return
    pieces = filter(None, _SEAM.split(line))
    for are_whole, alike in itertools.groupby(pieces, lambda piece: _is_whole(piece, key)):
        if are_whole:
            yield from alike
        else:
            yield b"".join(alike)


def _is_whole(line: bytes, key: str) -> bool:
    return line == _with_checksum(line[:-_END], key)


def _with_checksum(body: bytes, key: str) -> bytes:
    checksum = hashlib.sha256(key.encode() + b"\n" + body).hexdigest()
    return body + f', "sha256": "{checksum}"}}'.encode()


_END = len(_with_checksum(b"", ""))
