"""Files that are written whole or not at all, and errors that name them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have an `OSError` name the file: one of a full disk does not."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give another name to write a file under, which then takes its place, so that nobody finds half of it.

    Raises:
        OSError: the file cannot be written.
    """
    partial = path.with_name(f"{path.name}.partial")
    with naming(path):
        partial.unlink(missing_ok=True)  # it may be a link to another file
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())  # or a power failure could leave the name without the content
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def replace_file(path: Path, content: bytes) -> None:
    """Write a file as `replacing` does.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as partial:
        partial.write_bytes(content)
