"""Files of JSON lines that are only appended to, every line with a checksum."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from autdtorch.writing import naming, replace_file

logger = logging.getLogger(__name__)

SET_ASIDE = ".damaged"
"""End of the name of the file, beside the first, that keeps the lines which cannot be used."""

_DAMAGE = (ValueError, KeyError, TypeError, OverflowError, RuntimeError)  # by which a reader refuses a row


def line_of(row: Mapping[str, Any], key: str = "") -> bytes:
    """Return a row as a line, its last field the checksum of all before it; the line's end is left out.

    Args:
        row: what JSON can hold, by name; at least one field.
        key: what the line belongs to. It is part of the checksum, so that a line of elsewhere is told apart.
    """
    return _with_checksum(json.dumps(row)[:-1].encode(), key)


def row_of(line: bytes, key: str = "") -> dict[str, Any]:
    """Return the row of a line of `line_of`. Nothing is parsed before the checksum is found right.

    Raises:
        ValueError: the line is damaged, or of another key.
    """
    body = line[: -len(_with_checksum(b"", ""))]
    if line != _with_checksum(body, key):
        raise ValueError("its checksum is wrong")
    row: dict[str, Any] = json.loads(body + b"}")
    return row


class JsonLines:
    """An append-only file of JSON objects, one a line; `mend` comes before the first `append`.

    Attributes:
        used: number of the lines that were read and used.
    """

    def __init__(
        self, path: Path, key: str, use: Callable[[dict[str, Any]], None], head: bytes = b""
    ) -> None:
        """Read the file, if it is there; it is left as it is.

        Args:
            path: of the file.
            key: what the lines belong to.
            use: is given each row in turn. It refuses a row by a `ValueError`, or by the error of a missing
                field or of a wrong type.
            head: a first line, its end included, that the file begins with.

        Raises:
            OSError: the file cannot be read.
        """
        content = path.read_bytes() if path.exists() else b""
        *lines, self._tail = content.removeprefix(head).split(b"\n")
        good: list[bytes] = []
        self._refused: list[tuple[int, bytes, Exception]] = []
        for number, line in enumerate(lines, 2 if head and content.startswith(head) else 1):
            try:
                use(row_of(line, key))
            except _DAMAGE as error:
                self._refused.append((number, line, error))
            else:
                good.append(line)
        self.used = len(good)
        self._path, self._key = path, key
        mended = head + b"".join(line + b"\n" for line in good)
        self._mended = None if content == mended else mended
        self._size = len(mended)

    def mend(self) -> None:
        """Set aside the lines that were refused, cut off a last line that broke off, write a missing head.

        Raises:
            OSError: a file cannot be written; the one that was read is then as it was.
        """
        if self._refused:
            self._set_aside()
        if self._tail:
            logger.warning("%s: the last line broke off: cut off", self._path)
        if self._mended is not None:
            replace_file(self._path, self._mended)
            self._mended = None

    def append(self, *rows: Mapping[str, Any]) -> None:
        """Add lines, which are on disk on return, or leave the file as it is: nothing may follow half a line.

        Raises:
            ValueError: the file has changed since it was read or last appended to.
            OSError: the file cannot be written.
        """
        rest = memoryview(b"".join(line_of(row, self._key) + b"\n" for row in rows))
        with naming(self._path), self._path.open("ab", buffering=0) as file:
            if file.tell() != self._size:
                raise ValueError(f"{self._path}: has changed meanwhile; open it anew, or give another file")
            try:
                while rest:
                    rest = rest[file.write(rest) :]
                os.fsync(file.fileno())
                self._size = file.tell()
            except BaseException:
                file.truncate(self._size)
                raise

    def _set_aside(self) -> None:
        path = self._path.with_name(self._path.name + SET_ASIDE)
        with naming(path), path.open("ab") as file:
            file.writelines(line + b"\n" for _, line, _ in self._refused)
            file.flush()
            os.fsync(file.fileno())
        number, _, error = self._refused[0]
        reason = f"no {error}" if isinstance(error, KeyError) else error
        count = len(self._refused)
        more = f" and {count - 1} more" if count > 1 else ""
        logger.warning("%s, line %d%s: set aside in %s: %s", self._path, number, more, path, reason)


def _with_checksum(body: bytes, key: str) -> bytes:
    checksum = hashlib.sha256(key.encode() + b"\n" + body).hexdigest()
    return body + f', "sha256": "{checksum}"}}'.encode()
