"""Arrays in NumPy files, checked before they are allocated."""

from __future__ import annotations

import math
import os
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.files import replacing
from autdtorch.utils.values import within

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
