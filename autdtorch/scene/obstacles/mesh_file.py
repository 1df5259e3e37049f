"""Files of triangle meshes: STL, OBJ and PLY.

The readers are our own: VTK's and libigl's end the process on damaged PLY files, and trimesh cuts polygons
that are not convex into triangles outside them (`docs/decisions/obstacles.md`).
"""

from __future__ import annotations

from pathlib import Path

from autdtorch.scene.obstacles.mesh_obj import read_obj
from autdtorch.scene.obstacles.mesh_ply import read_ply
from autdtorch.scene.obstacles.mesh_polygons import triangulated
from autdtorch.scene.obstacles.mesh_solid import Triangles
from autdtorch.scene.obstacles.mesh_stl import read_stl
from autdtorch.utils.validation import invalid, path_of

_READERS = {".stl": read_stl, ".obj": read_obj, ".ply": read_ply}
_OTHERS = {
    b"version https://git-lfs": "a Git LFS pointer in place of the file; fetch it by `git lfs pull`",
    b"<!doctype html": "a page of HTML; download the file itself",
    b"<html": "a page of HTML; download the file itself",
    b"pk\x03\x04": "a zip archive; unpack it",
}
"""What begins like this, in lower case, is no mesh."""


def read_mesh(given: object) -> tuple[str, Triangles]:
    """Return the checked path of a mesh file and the triangles in it."""
    path = path_of("Mesh.path", given, suffixes=tuple(_READERS))
    if not path.is_file():
        raise invalid("Mesh.path", str(path), "must be an existing file")
    try:
        _require_mesh(path)
        polygons = _READERS[path.suffix.lower()](str(path))
        if not len(polygons.lengths):
            points = f"{len(polygons.vertices)} points and no faces" if len(polygons.vertices) else "no faces"
            raise ValueError(f"it has {points}; must be a surface")
        return str(path), (polygons.vertices, triangulated(polygons))
    except (RuntimeError, ValueError, LookupError, OverflowError) as error:
        raise invalid("Mesh.path", str(path), f"must be a mesh file ({error})") from error


def _require_mesh(path: Path) -> None:
    with path.open("rb") as file:
        begin = file.read(256).lstrip().lower()
    if not begin:
        raise ValueError("it is empty")
    for mark, found in _OTHERS.items():
        if begin.startswith(mark):
            raise ValueError(f"it is {found}")
