"""Bodies enclosed by triangle meshes. libigl reads STL files and computes distances."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.mesh_file import read_obj, read_ply
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.digest import digest_of
from autdtorch.utils.validation import Vector, finite_vector, invalid, path_of, positive

_FORMATS = (".stl", ".obj", ".ply")

_FARTHEST = 1e100  # largest coordinate of a vertex, in units of the file; volumes do not overflow


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
    path = path_of("Mesh.path", given)
    if path.suffix.lower() not in _FORMATS:
        raise invalid("Mesh.path", str(path), f"must end in one of {', '.join(_FORMATS)}")
    if not path.is_file():
        raise invalid("Mesh.path", str(path), "must be an existing file")
    mesh = _MeshPath(path)
    mesh.vertices, mesh.faces = _read(str(path))
    return mesh


def _read(path: str) -> tuple[Array, Index]:
    """Return the distinct vertices (V, 3) and the outward faces (F, 3) of a watertight mesh."""
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
