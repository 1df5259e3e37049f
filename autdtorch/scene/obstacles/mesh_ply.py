"""PLY files, of text or binary."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from autdtorch.scene.obstacles.mesh_polygons import Polygons
from autdtorch.utils.array_types import Array, Index

_HEAD = re.compile(rb"ply\s*?\n.*?\nend_header\s*?\n", re.DOTALL)
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_CORNERS = ("vertex_indices", "vertex_index")


class _Property(NamedTuple):
    """A number of an element, or a list of them with its own length."""

    name: str
    length: np.dtype[Any] | None  # of the length; None for a number
    entry: np.dtype[Any]


class _Element(NamedTuple):
    """What the header tells of an element."""

    name: str
    size: int
    properties: list[_Property]


class _Column(NamedTuple):
    """The values of a property (sum of lengths,), and how many each element has (n,)."""

    lengths: Index
    values: Array


_Table: TypeAlias = dict[str, _Column]


def read_ply(path: str) -> Polygons:
    """Read the vertices and polygons of a PLY file; other properties are ignored.

    Raises:
        ValueError: no header, no faces, numbers that are not of their type, or a file that ends too early.
    """
    content = Path(path).read_bytes()
    if (head := _HEAD.match(content)) is None:
        raise ValueError("no header of a PLY file")
    order, elements = _elements(head[0].decode("ascii", errors="replace"))
    body = content[head.end() :]
    stream = _Bytes(body) if order else _Words(body)
    tables = {element.name: _table(stream, element) for element in elements}
    if "vertex" not in tables or any(axis not in tables["vertex"] for axis in "xyz"):
        raise ValueError("no element 'vertex' with x, y and z")
    column = next((tables.get("face", {})[name] for name in _CORNERS if name in tables.get("face", {})), None)
    if column is None or not len(column.lengths):
        raise ValueError("no faces, only points; must be a surface")
    if not (np.isfinite(column.values) & (column.values == np.trunc(column.values))).all():
        raise ValueError("indices of vertices that are not whole numbers")
    vertices = np.stack([tables["vertex"][axis].values for axis in "xyz"], axis=1).astype(np.float64)
    return Polygons(vertices, column.lengths, column.values.astype(np.int64))


def _elements(head: str) -> tuple[str, list[_Element]]:
    """Return the byte order, empty for text, and the elements."""
    order, elements = "", list[_Element]()
    for line in head.splitlines():
        match line.split():
            case ["format", kind, *_]:
                if kind not in _ORDERS:
                    raise ValueError(f"format {kind!r}; must be one of {', '.join(_ORDERS)}")
                order = _ORDERS[kind]
            case ["element", name, count]:
                if int(count) < 0:
                    raise ValueError(f"{count} elements {name!r}; must be at least 0")
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, entry, name]:
                elements[-1].properties.append(_Property(name, _dtype(order, length), _dtype(order, entry)))
            case ["property", kind, name]:
                elements[-1].properties.append(_Property(name, None, _dtype(order, kind)))
    return order, elements


def _dtype(order: str, name: str) -> np.dtype[Any]:
    if name not in _CODES:
        raise ValueError(f"type {name!r}; must be one of {', '.join(_CODES)}")
    return np.dtype(order + _CODES[name])


class _Bytes:
    """The numbers of a binary file, one after the other."""

    def __init__(self, body: bytes) -> None:
        self._body, self.place = body, 0

    def rows(self, types: list[np.dtype[Any]], widths: list[int], count: int) -> list[Array]:
        """Return the next columns (count, width), one for each type and width."""
        dtype = np.dtype(
            [(str(number), *each) for number, each in enumerate(zip(types, widths, strict=True))]
        )
        if self.place + count * dtype.itemsize > len(self._body):
            raise ValueError("the file ends too early")
        table = np.frombuffer(self._body, dtype, count, self.place)
        self.place += count * dtype.itemsize
        return [table[name].reshape(count, -1) for name in dtype.names or ()]


class _Words:
    """The numbers of a text file, one after the other."""

    def __init__(self, body: bytes) -> None:
        self._words, self.place = np.array(body.split()).astype(np.float64), 0

    def rows(self, types: list[np.dtype[Any]], widths: list[int], count: int) -> list[Array]:
        """Return the next columns (count, width), one for each type and width."""
        some = self._words[self.place : self.place + count * sum(widths)]
        if len(some) < count * sum(widths):
            raise ValueError("the file ends too early")
        self.place += len(some)
        columns = np.split(some.reshape(count, sum(widths)), np.cumsum(widths)[:-1], axis=1)
        for dtype, column in zip(types, columns, strict=True):
            if dtype.kind in "iu" and len(column):
                limits = np.iinfo(dtype)
                if not ((column == np.trunc(column)) & (column >= limits.min) & (column <= limits.max)).all():
                    raise ValueError(f"numbers that are not of the type declared, {dtype.name}")
        return columns


def _table(stream: _Bytes | _Words, element: _Element) -> _Table:
    """Return the columns of an element: at once where all lists have the lengths of the first, as usual."""
    if not element.size:
        return {each.name: _Column(np.zeros(0, np.int64), np.zeros(0)) for each in element.properties}
    begin = stream.place
    first = [_row(stream, each) for each in element.properties]
    stream.place = begin
    if (same := _alike(stream, element, [len(own) for own in first])) is not None:
        return same
    stream.place = begin
    lists: list[list[Array]] = [[] for _ in element.properties]
    for _ in range(element.size):
        for own, each in zip(lists, element.properties, strict=True):
            own.append(_row(stream, each))
    return {
        each.name: _Column(np.array([len(row) for row in own]), np.concatenate(own))
        for each, own in zip(element.properties, lists, strict=True)
    }


def _row(stream: _Bytes | _Words, each: _Property) -> Array:
    """Return the next number or list."""
    count = 1 if each.length is None else int(stream.rows([each.length], [1], 1)[0].item())
    if count < 0:
        raise ValueError(f"a list {each.name!r} of {count} entries; must be at least 0")
    return stream.rows([each.entry], [1], count)[0].ravel()


def _alike(stream: _Bytes | _Words, element: _Element, lengths: list[int]) -> _Table | None:
    """Return the columns of an element whose lists all have these lengths, or None."""
    types, widths = list[np.dtype[Any]](), list[int]()
    for each, length in zip(element.properties, lengths, strict=True):
        types += [each.entry] if each.length is None else [each.length, each.entry]
        widths += [1] if each.length is None else [1, length]
    try:
        columns = iter(stream.rows(types, widths, element.size))
    except ValueError:  # longer than the file: some lists are shorter
        return None
    table = {}
    for each, length in zip(element.properties, lengths, strict=True):
        if each.length is not None and (next(columns) != length).any():
            return None
        table[each.name] = _Column(np.full(element.size, length), next(columns).ravel())
    return table
