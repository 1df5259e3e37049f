"""Files of triangle meshes: STL, OBJ and PLY.

libigl reads STL files. Its readers of OBJ and PLY crash on damaged or forged files.
"""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured, unstructured_to_structured

from autdtorch.scene.obstacles.mesh_solid import Triangles
from autdtorch.utils.validation import invalid, path_of

_FORMATS = (".stl", ".obj", ".ply")

_Element: TypeAlias = tuple[str, int, Any]
_HEAD = re.compile(rb"ply\r?\n.*?\nend_header\r?\n", re.DOTALL)
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_LENGTH = " length"  # suffix of the column with the lengths of a list


def read_mesh(given: object) -> tuple[str, Triangles]:
    """Return the checked path of a mesh file and the triangles in it."""
    import igl

    path = path_of("Mesh.path", given, suffixes=_FORMATS)
    if not path.is_file():
        raise invalid("Mesh.path", str(path), "must be an existing file")
    readers = {".obj": read_obj, ".ply": read_ply}
    try:
        return str(path), readers.get(path.suffix.lower(), igl.read_triangle_mesh)(str(path))
    except (RuntimeError, ValueError, LookupError, OverflowError) as error:
        raise invalid("Mesh.path", str(path), f"must be a mesh file ({error})") from error


def read_obj(path: str) -> Triangles:
    """Read the triangles of an OBJ file; polygons become fans of triangles."""
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    with Path(path).open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            kind, *words = line.split() or [""]
            try:
                if kind == "v":
                    x, y, z = map(float, words[:3])
                    vertices.append([x, y, z])
                elif kind == "f":
                    if len(words) < 3:
                        raise ValueError(f"a face of {len(words)} vertices; must be at least 3")
                    first, *others = (_index(word, len(vertices)) for word in words)
                    faces += [[first, *pair] for pair in itertools.pairwise(others)]
            except ValueError as error:
                raise ValueError(f"line {number}: {error}") from error
    return np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)


def read_ply(path: str) -> Triangles:
    """Read the triangles of a PLY file."""
    content = Path(path).read_bytes()
    if (head := _HEAD.match(content)) is None:
        raise ValueError("no header of a PLY file")
    order, elements = _elements(head[0].decode("ascii", errors="replace"))
    body = content[head.end() :]
    tables = _binary(body, elements) if order else _text(body, elements)
    for table in tables.values():
        lengths = [table[column] for column in table.dtype.names if column.endswith(_LENGTH)]
        if not all((length == 3).all() for length in lengths):
            raise ValueError("lists without exactly three entries")
    vertex, face = tables["vertex"], tables["face"]
    corners = face["vertex_indices" if "vertex_indices" in face.dtype.names else "vertex_index"]
    if not (np.isfinite(corners) & (corners == np.trunc(corners))).all():
        raise ValueError("indices of vertices that are not whole numbers")
    return np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64), corners.astype(np.int64)


def _index(word: str, count: int) -> int:
    """Return an index from 0; the file counts from 1, or backwards from the last of `count` vertices."""
    index = int(word.partition("/")[0])
    if index == 0:
        raise ValueError("vertex 0; vertices are counted from 1")
    return index - 1 if index > 0 else count + index


def _elements(head: str) -> tuple[str, list[_Element]]:
    """Return the byte order, empty for text, and name, count and dtype of each element, lists of three."""
    order = ""
    columns: list[tuple[str, int, list[Any]]] = []
    for line in head.splitlines():
        match line.split():
            case ["format", kind, *_]:
                order = _ORDERS.get(kind, "")
            case ["element", name, count]:
                if int(count) < 0:
                    raise ValueError(f"{count} elements {name!r}; must be at least 0")
                columns.append((name, int(count), []))
            case ["property", "list", length, entry, name]:
                columns[-1][2].append((name + _LENGTH, order + _CODES[length]))
                columns[-1][2].append((name, order + _CODES[entry], (3,)))
            case ["property", kind, name]:
                columns[-1][2].append((name, order + _CODES[kind]))
    return order, [(name, count, np.dtype(fields)) for name, count, fields in columns]


def _binary(body: bytes, elements: list[_Element]) -> dict[str, Any]:
    tables, offset = {}, 0
    for name, count, dtype in elements:
        tables[name] = np.frombuffer(body, dtype, count, offset)
        offset += count * dtype.itemsize
    return tables


def _text(body: bytes, elements: list[_Element]) -> dict[str, Any]:
    tables, numbers = {}, np.array(body.split(), np.float64)
    for name, count, dtype in elements:
        widths = [dtype[column].shape[0] if dtype[column].shape else 1 for column in dtype.names]
        rows, numbers = numbers[: count * sum(widths)], numbers[count * sum(widths) :]
        rows = rows.reshape(count, sum(widths))
        with np.errstate(invalid="ignore"):  # fractions are refused below
            tables[name] = unstructured_to_structured(rows, dtype)
        integer = np.repeat([dtype[column].base.kind in "iu" for column in dtype.names], widths)
        if (structured_to_unstructured(tables[name], np.float64) != rows)[:, integer].any():
            raise ValueError(f"elements {name!r} with numbers that are not of the type declared")
    return tables
