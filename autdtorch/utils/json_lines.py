"""Append-only files of JSON lines, each with a checksum."""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from autdtorch.utils.files import naming, replace_file

logger = logging.getLogger(__name__)

SET_ASIDE = ".damaged"  # suffix of the file, next to the first, that keeps the lines that cannot be used
_SEAM = re.compile(rb'(?=\{")|(?<="\})')  # possible start or end of a row without nested objects
_WRONG_CHECKSUM = "its checksum is wrong"
_BROKE_OFF = "the last line broke off"
_DAMAGE = (ValueError, KeyError, TypeError, OverflowError, RuntimeError)  # errors of a refused row


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
                except _DAMAGE as error:
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
