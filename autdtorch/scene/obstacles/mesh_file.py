"""Files of triangle meshes: STL, OBJ and PLY.

Other readers do not serve: VTK's and libigl's end the process on damaged PLY files, and trimesh cuts polygons
that are not convex into triangles outside them (`docs/decisions/obstacles.md`).
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from autdtorch.scene.obstacles.mesh_solid import Triangles
from autdtorch.scene.obstacles.polygons import Polygons, triangulated
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.files import path_of
from autdtorch.utils.validation import invalid

# Beginnings, in lower case, of files that are no meshes
_OTHERS = {
    b"version https://git-lfs": "a Git LFS pointer in place of the file; fetch it by `git lfs pull`",
    b"<!doctype html": "a page of HTML; download the file itself",
    b"<html": "a page of HTML; download the file itself",
    b"pk\x03\x04": "a zip archive; unpack it",
}

# STL: bytes of the head of a binary file, and of each triangle
_STL_HEAD, _FACET = 84, 50
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_FACET_BEGIN = re.compile(rb"(?<!end)\bfacet\b", re.IGNORECASE)
_FACET_END = re.compile(rb"\bend\s*facet\b", re.IGNORECASE)
_MARK = b"\xef\xbb\xbf"  # of UTF-8, which editors put before text

# PLY
_PLY_HEAD = re.compile(rb"ply\s*?\n.*?\nend_header\s*?\n", re.DOTALL)
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_CORNERS = ("vertex_indices", "vertex_index")


def read_mesh(path: object) -> tuple[str, Triangles]:
    """Return the checked path of a mesh file and the triangles in it."""
    file = path_of("Mesh.path", path, suffixes=tuple(_READERS))
    if not file.is_file():
        raise invalid("Mesh.path", str(file), "must be an existing file")
    try:
        content = file.read_bytes()
        _require_mesh(content)
        polygons = _READERS[file.suffix.lower()](content)
        if not len(polygons.lengths):
            points = f"{len(polygons.vertices)} points and no faces" if len(polygons.vertices) else "no faces"
            raise ValueError(f"it has {points}; must be a surface")
        return str(file), (polygons.vertices, triangulated(polygons))
    except (RuntimeError, ValueError, LookupError, OverflowError) as error:
        raise invalid("Mesh.path", str(file), f"must be a mesh file ({error})") from error


def _require_mesh(content: bytes) -> None:
    begin = content[:256].lstrip().lower()
    if not begin:
        raise ValueError("it is empty")
    for mark, other in _OTHERS.items():
        if begin.startswith(mark):
            raise ValueError(f"it is {other}")


def _stl(content: bytes) -> Polygons:
    """Return the triangles of an STL file, of text or binary.

    Both kinds may begin with "solid". The length tells a binary file; more bytes at its end are ignored.

    Raises:
        ValueError: neither text nor binary, or one that ends too early.
    """
    begin = content[:_STL_HEAD].removeprefix(_MARK).lstrip()[:5].lower()
    count = int.from_bytes(content[_STL_HEAD - 4 : _STL_HEAD], "little")
    exact = len(content) == _STL_HEAD + _FACET * count
    if begin == b"solid" and not exact and _VERTEX.search(content):
        return _stl_text(content)
    if len(content) < _STL_HEAD:
        raise ValueError("neither text with facets nor a binary STL file")
    if len(content) < _STL_HEAD + _FACET * count:
        fit = (len(content) - _STL_HEAD) // _FACET
        short = f"its head tells of {count} triangles, {fit} fit"
        raise ValueError(f"neither text with facets nor a whole binary STL file: {short}")
    records = np.frombuffer(content, _RECORD, count, _STL_HEAD)
    return _separate(records["corners"].astype(np.float64))


def _stl_text(content: bytes) -> Polygons:
    vertices = _VERTEX.findall(content)
    begun, ended = (len(each.findall(content)) for each in (_FACET_BEGIN, _FACET_END))
    if not 3 * begun == 3 * ended == len(vertices):
        many = f"{begun} facets begin and {ended} end, with {len(vertices)} vertices in all"
        raise ValueError(f"{many}; must be three vertices a facet")
    try:
        corners = np.array(vertices).astype(np.float64)
    except ValueError as error:
        raise ValueError(f"a vertex without three numbers ({error})") from error
    return _separate(corners)


def _separate(corners: np.ndarray) -> Polygons:
    """Return triangles without common vertices."""
    vertices = corners.reshape(-1, 3)
    return Polygons(vertices, np.full(len(vertices) // 3, 3), np.arange(len(vertices)))


def _obj(content: bytes) -> Polygons:
    """Return the vertices and polygons of an OBJ file; texture, normals, groups and materials are ignored.

    Raises:
        ValueError: a line that is no vertex or face; the message names it.
    """
    vertices: list[list[float]] = []
    lengths: list[int] = []
    corners: list[int] = []
    for number, line in _joined(io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", "replace")):
        kind, *words = line.split() or [""]
        try:
            if kind == "v":
                x, y, z = map(float, words[:3])
                vertices.append([x, y, z])
            elif kind == "f":
                if len(words) < 3:
                    raise ValueError(f"a face of {len(words)} vertices; must be at least 3")
                corners += [_index(word, len(vertices)) for word in words]
                lengths.append(len(words))
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
    places = np.array(vertices, np.float64).reshape(-1, 3)
    return Polygons(places, np.array(lengths, np.int64), np.array(corners, np.int64))


def _joined(lines: Iterable[str]) -> Iterator[tuple[int, str]]:
    r"""Return lines and their numbers from 1; a line that ends with \ goes on in the next one."""
    begun = ""
    number = 0
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].rstrip()
        if text.endswith("\\"):
            begun += text[:-1] + " "
            continue
        yield number, begun + text
        begun = ""
    if begun:
        yield number, begun


def _index(word: str, count: int) -> int:
    """Return an index from 0; the file counts from 1, or backwards from the last of `count` vertices."""
    index = int(word.partition("/")[0])
    if index == 0:
        raise ValueError("vertex 0; vertices are counted from 1")
    return index - 1 if index > 0 else count + index


class _Property(NamedTuple):
    """A number of an element, or a list of them with its length."""

    name: str
    length: np.dtype[Any] | None  # of the length; None for a number
    entry: np.dtype[Any]


class _Element(NamedTuple):
    """The name, size and properties of an element, from the header."""

    name: str
    size: int
    properties: list[_Property]


_Table: TypeAlias = dict[str, tuple[Index, Array]]
"""Properties by name: the number of values of each element (n,), and all values (sum of these,)."""


def _ply(content: bytes) -> Polygons:
    """Return the vertices and polygons of a PLY file; other properties are ignored.

    Raises:
        ValueError: no header, no faces, numbers that are not of their type, or a file that ends too early.
    """
    if (head := _PLY_HEAD.match(content)) is None:
        raise ValueError("no header of a PLY file")
    order, elements = _elements(head[0].decode("ascii", errors="replace"))
    stream = (_Bytes if order else _Words)(content[head.end() :])
    tables = {element.name: _table(stream, element) for element in elements}
    if "vertex" not in tables or any(axis not in tables["vertex"] for axis in "xyz"):
        raise ValueError("no element 'vertex' with x, y and z")
    column = next((tables.get("face", {})[name] for name in _CORNERS if name in tables.get("face", {})), None)
    if column is None or not len(column[0]):
        raise ValueError("no faces, only points; must be a surface")
    lengths, corners = column
    if not (np.isfinite(corners) & (corners == np.trunc(corners))).all():
        raise ValueError("indices of vertices that are not whole numbers")
    vertices = np.stack([tables["vertex"][axis][1] for axis in "xyz"], axis=1).astype(np.float64)
    return Polygons(vertices, lengths, corners.astype(np.int64))


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
        dtype = np.dtype([(str(n), *each) for n, each in enumerate(zip(types, widths, strict=True))])
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
        return {each.name: (np.zeros(0, np.int64), np.zeros(0)) for each in element.properties}
    begin = stream.place
    first = [_row(stream, each) for each in element.properties]
    stream.place = begin
    if (table := _alike(stream, element, [len(row) for row in first])) is not None:
        return table
    stream.place = begin
    lists: list[list[Array]] = [[] for _ in element.properties]
    for _ in range(element.size):
        for rows, each in zip(lists, element.properties, strict=True):
            rows.append(_row(stream, each))
    return {
        each.name: (np.array([len(row) for row in rows]), np.concatenate(rows))
        for each, rows in zip(element.properties, lists, strict=True)
    }


def _row(stream: _Bytes | _Words, each: _Property) -> Array:
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
        table[each.name] = np.full(element.size, length), next(columns).ravel()
    return table


_READERS = {".stl": _stl, ".obj": _obj, ".ply": _ply}
