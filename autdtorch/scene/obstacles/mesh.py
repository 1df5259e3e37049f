"""Bodies enclosed by triangle meshes, and the files that hold them.

libigl reads STL files and computes distances. Its readers of OBJ and PLY crash on damaged or forged files.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.lib.recfunctions import structured_to_unstructured, unstructured_to_structured

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.digest import digest_of
from autdtorch.utils.validation import Vector, finite_vector, invalid, path_of, positive

_FORMATS = (".stl", ".obj", ".ply")

_FARTHEST = 1e100  # largest coordinate of a vertex, in units of the file; volumes do not overflow

Triangles: TypeAlias = tuple[Array, Index]
"""Vertices (V, 3) and the indices of each triangle's vertices (F, 3)."""

_Element: TypeAlias = tuple[str, int, Any]
_HEAD = re.compile(rb"ply\r?\n.*?\nend_header\r?\n", re.DOTALL)
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_LENGTH = " length"  # suffix of the column with the lengths of a list


class _MeshPath(str):
    """The path of a mesh file and its triangles; `dataclasses.replace` passes both on, so it is read once."""

    vertices: Array
    faces: Index


@dataclass(frozen=True)
class Mesh(Obstacle):
    """The inside of a watertight triangle mesh from an STL, OBJ or PLY file.

    A point r of the file has the position R(rotation) scale r + offset in the scene. Triangles may enclose
    cavities and several bodies, but must not intersect.

    Attributes:
        path: of the file. It is read once; `dataclasses.replace` keeps the triangles.
        scale: metres per unit of the file, > 0; 1e-3 for a file in millimetres.
        offset: position of the file's origin (3,) [m].
        rotation: angles (3,) [rad] about the file's origin; see `autdtorch.scene.geometry.rotation_matrix`.
        vertices: (V, 3) [m], float64, in the scene.
        faces: vertices of each triangle (F, 3), int64, counter-clockwise as seen from outside.
        digest: of vertices and faces. Meshes of equal digest and material are equal, whatever their files.

    Raises:
        ValueError: no such file, not a watertight mesh, or an attribute that is not finite, has the wrong
            shape or is out of range; see also `Obstacle`.
    """

    path: str = field(compare=False)
    scale: float = field(default=1.0, compare=False)
    offset: Vector = field(default=(0.0, 0.0, 0.0), compare=False)
    rotation: Vector = field(default=(0.0, 0.0, 0.0), compare=False)
    vertices: torch.Tensor = field(init=False, repr=False, compare=False)
    faces: torch.Tensor = field(init=False, repr=False, compare=False)
    digest: str = field(init=False)

    def __post_init__(self) -> None:
        """Check the attributes and read the file."""
        super().__post_init__()
        object.__setattr__(self, "scale", positive("Mesh.scale", self.scale))
        object.__setattr__(self, "offset", finite_vector("Mesh.offset", self.offset))
        object.__setattr__(self, "rotation", finite_vector("Mesh.rotation", self.rotation, "rad"))
        path = self.path if isinstance(self.path, _MeshPath) else _read_path(self.path)
        object.__setattr__(self, "path", path)
        vertices = self.scale * torch.from_numpy(path.vertices) @ rotation_matrix(self.rotation).T
        vertices = vertices + vertices.new_tensor(self.offset)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", torch.from_numpy(path.faces))
        object.__setattr__(self, "digest", digest_of(vertices, self.faces)[:16])

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        x, y, z = self.vertices.amin(dim=0).tolist()
        return x, y, z

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
        x, y, z = self.vertices.amax(dim=0).tolist()
        return x, y, z

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return copies of `vertices` and `faces`; see `Obstacle.surface`."""
        return self.vertices.clone(), self.faces.clone()

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        """Measure to the nearest triangle, with the sign of its pseudonormal (Baerentzen & Aanaes 2005)."""
        if len(points) == 0:
            return points.new_zeros(0)
        import igl

        queries = np.ascontiguousarray(points.detach().cpu().numpy())
        kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        distance = igl.signed_distance(queries, self.vertices.numpy(), self.faces.numpy(), sign_type=kind)[0]
        return torch.from_numpy(distance).to(points)


def _read_path(given: object) -> _MeshPath:
    """Check the path of a mesh file and read it."""
    path = path_of("Mesh.path", given, suffixes=_FORMATS)
    if not path.is_file():
        raise invalid("Mesh.path", str(path), "must be an existing file")
    mesh = _MeshPath(path)
    mesh.vertices, mesh.faces = _read(str(path))
    return mesh


def _read(path: str) -> Triangles:
    """Return the distinct vertices and the outward faces of a watertight mesh."""
    import igl

    readers = {".obj": read_obj, ".ply": read_ply}
    try:
        corners, triangles = readers.get(Path(path).suffix.lower(), igl.read_triangle_mesh)(path)
    except (RuntimeError, ValueError, LookupError, OverflowError) as error:
        raise invalid("Mesh.path", path, f"must be a mesh file ({error})") from error
    whole = triangles.size > 0 and 0 <= triangles.min() <= triangles.max() < len(corners)
    if not whole or triangles.shape[1] != 3 or not (np.abs(corners) <= _FARTHEST).all():
        accepted = f"triangles with finite vertices, none beyond {_FARTHEST:g}"
        raise invalid("Mesh.path", path, f"must be a mesh file that holds {accepted}")
    # STL repeats a vertex for every triangle at it.
    vertices, index = np.unique(corners + 0.0, axis=0, return_inverse=True)
    faces = index.reshape(-1)[triangles].astype(np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _require_watertight(path, faces)
    volume = np.linalg.det(vertices[faces] - vertices.mean(axis=0)).sum() / 6
    if volume == 0:
        raise invalid("Mesh.path", path, "must enclose a volume")
    return vertices, faces if volume > 0 else np.ascontiguousarray(faces[:, ::-1])


def _require_watertight(path: str, faces: Index) -> None:
    """Check that every edge joins two triangles, which run through it in opposite directions."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, edge, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    balance = np.bincount(edge.reshape(-1), weights=np.where(edges[:, 0] < edges[:, 1], 1, -1))
    wrong = int(((count != 2) | (balance != 0)).sum())
    if wrong or len(edges) == 0:
        found = f"{wrong} of its {len(count)} edges do not join two triangles of one orientation"
        raise invalid("Mesh.path", path, f"{found}, must be watertight")


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
