"""Bodies enclosed by triangle meshes."""

from __future__ import annotations

import logging
from dataclasses import InitVar, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.mesh_distance import MeshDistance
from autdtorch.scene.obstacles.mesh_file import read_mesh
from autdtorch.scene.obstacles.mesh_repair import repaired
from autdtorch.scene.obstacles.mesh_solid import Triangles, outer_parts, solid_of
from autdtorch.utils.array_types import Array, Index, triple
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import replacing
from autdtorch.utils.hints import suggesting
from autdtorch.utils.process import cached_property
from autdtorch.utils.units import angles
from autdtorch.utils.validation import Vector, boolean, finite_vector, invalid, positive, real_tensor, within

logger = logging.getLogger(__name__)

_MOST = 2**53  # largest whole number that is exact in double precision


class _Source(str):
    """The path of a mesh file and its triangles; `dataclasses.replace` passes both on, so it is read once."""

    vertices: Array
    faces: Index

    @cached_property
    def distance(self) -> MeshDistance:
        """The distance to the triangles, in units of the file."""
        return MeshDistance(self.vertices, self.faces)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the search structures, which are built again."""
        return {name: value for name, value in vars(self).items() if name != "distance"}


@dataclass(frozen=True)
class Mesh(Obstacle):
    """The inside of a watertight triangle mesh, from an STL, OBJ or PLY file or by `from_surface`.

    A point r of the file has the position R(rotation) scale r + offset in the scene. Triangles may enclose
    cavities, and several parts, which become one body where they overlap or touch: slits up to 2e-5 of the
    extent close. A part must not cross itself.

    Attributes:
        path: of the file, empty without one. It is read once; `dataclasses.replace` keeps the triangles.
        scale: metres per unit of the file, > 0; 1e-3 for a file in millimetres.
        offset: position of the file's origin (3,) [m].
        rotation: angles (3,) [rad] about the file's origin; see `autdtorch.scene.geometry.rotation_matrix`.
        rotation_degrees: these angles (3,) in degrees, in place of `rotation`; it is no attribute afterwards.
        repair: whether to mend a mesh that is not watertight. Vertices up to 1e-3 of the extent apart are
            joined, triangles turned over, doubled ones and stray pieces left out, and holes up to 30 % of the
            area closed. A surface that crosses itself is replaced by a new one. A warning in the log says so.
        vertices: (V, 3) [m], float64, in the scene.
        faces: vertices of each triangle (F, 3), int64, counter-clockwise as seen from outside.
        digest: of vertices and faces. Meshes of equal digest and material are equal, whatever their files.

    Raises:
        ValueError: no such file, no watertight mesh, a part that crosses itself or is inside out, or an
            attribute that is not finite, has the wrong shape or is out of range; see also `Obstacle`. The
            message names the place in the mesh.
    """

    position_field: ClassVar[str] = "offset"
    orientation_field: ClassVar[str | None] = "rotation"
    unit_question: ClassVar[str] = "take scale=1e-3 for a file in millimetres, 1e-2 for centimetres"

    path: str = field(compare=False)
    scale: float = field(default=1.0, compare=False)
    offset: Vector = field(default=(0.0, 0.0, 0.0), compare=False)
    rotation: Vector = field(default=(0.0, 0.0, 0.0), compare=False)
    repair: bool = field(default=False, compare=False)
    rotation_degrees: InitVar[Vector | None] = field(default=None, kw_only=True)
    vertices: torch.Tensor = field(init=False, repr=False, compare=False)
    faces: torch.Tensor = field(init=False, repr=False, compare=False)
    digest: str = field(init=False)

    def __post_init__(self, rotation_degrees: Vector | None) -> None:
        super().__post_init__()
        object.__setattr__(self, "scale", positive("Mesh.scale", self.scale))
        object.__setattr__(self, "offset", finite_vector("Mesh.offset", self.offset))
        object.__setattr__(self, "rotation", angles("Mesh.rotation", self.rotation, rotation_degrees))
        repair = boolean("Mesh.repair", self.repair)
        path = self.path if isinstance(self.path, _Source) else _read(self.path, repair)
        object.__setattr__(self, "path", path)
        vertices = self.scale * torch.from_numpy(path.vertices) @ rotation_matrix(self.rotation).T
        vertices = vertices + vertices.new_tensor(self.offset)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", torch.from_numpy(path.faces))
        object.__setattr__(self, "digest", digest_of(vertices, self.faces)[:16])

    @property
    def has_unsure_units(self) -> bool:
        """True without a scale."""
        return self.scale == 1

    @classmethod
    @suggesting
    def from_surface(
        cls,
        surface: Any,
        scale: float = 1.0,
        offset: Vector = (0.0, 0.0, 0.0),
        rotation: Vector = (0.0, 0.0, 0.0),
        repair: bool = False,
        *,
        rotation_degrees: Vector | None = None,
        density: complex | None = None,
        sound_speed: complex | None = None,
        rigid: bool = False,
        absorption: float = 0.0,
        impedance: complex | None = None,
    ) -> Mesh:
        """Make a mesh of vertices (V, 3) and triangles of their indices (F, 3), or of a PyVista `PolyData`.

        Indices count from 0. PyVista's polygons are cut into triangles. For the other arguments see `Mesh`,
        and for the material see `Obstacle`.

        Raises:
            ValueError: neither of both, or no watertight mesh; see also `Mesh`.
        """
        source = _Source("")
        with within("Mesh.surface"):
            source.vertices, source.faces = _solid(_triangles(surface), boolean("repair", repair))
        material: dict[str, Any] = {"density": density, "sound_speed": sound_speed, "rigid": rigid}
        material |= {"absorption": absorption, "impedance": impedance}
        return cls(source, scale, offset, rotation, repair, rotation_degrees=rotation_degrees, **material)

    def filled(self) -> Self:
        """Return the mesh without its cavities and what is in them; see `Obstacle.filled`."""
        outer = outer_parts(*self.triangles)
        if outer.all():
            return self
        source = _Source(self._source)
        source.vertices, source.faces = self._source.vertices, self._source.faces[outer]
        return replace(self, path=source)

    @property
    def triangles(self) -> Triangles:
        """Vertices (V, 3) in the coordinates and units of the file, and `faces`; not to be changed."""
        return self._source.vertices, self._source.faces

    def section(self, name: str) -> dict[str, Any]:
        """Return the section, with the path of `write_file`; see `Obstacle.section`."""
        section = super().section(name) | {"path": f"{name}.obj"}
        section.pop("repair", None)  # the file has the triangles of the body
        return section

    def write_file(self, path: Path) -> None:
        """Write the triangles, in the coordinates of the file, to an .obj file; see `Obstacle.write_file`."""
        with replacing(path.with_name(f"{path.name}.obj")) as partial, partial.open("wb") as file:
            np.savetxt(file, self.triangles[0], fmt="v %.17g %.17g %.17g")
            np.savetxt(file, self.triangles[1] + 1, fmt="f %d %d %d")

    @cached_property
    def lower(self) -> Vector:
        """Lower corner of the bounding box (3,) [m]."""
        return triple(self.vertices.amin(dim=0).tolist())

    @cached_property
    def upper(self) -> Vector:
        """Upper corner of the bounding box (3,) [m]."""
        return triple(self.vertices.amax(dim=0).tolist())

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return copies of `vertices` and `faces`; see `Obstacle.surface`."""
        return self.vertices.clone(), self.faces.clone()

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        """Measure in the coordinates of the file, whose search structures serve every place of the mesh."""
        from_origin = points.detach().cpu() - points.new_tensor(self.offset).cpu()
        in_file = from_origin @ rotation_matrix(self.rotation) / self.scale
        return torch.from_numpy(self.scale * self._source.distance(in_file.numpy())).to(points)

    @property
    def _source(self) -> _Source:
        assert isinstance(self.path, _Source)
        return self.path


def _solid(triangles: Triangles, repair: bool) -> Triangles:
    if not repair:
        return solid_of(*triangles)
    vertices, faces, done = repaired(*triangles)
    if done:
        logger.warning("the mesh is repaired, in units of the file: %s", "; ".join(done))
    return vertices, faces


def _read(path: object, repair: bool) -> _Source:
    path, triangles = read_mesh(path)
    source = _Source(path)
    try:
        source.vertices, source.faces = _solid(triangles, repair)
    except ValueError as error:
        raise invalid("Mesh.path", path, str(error)) from error
    return source


def _triangles(surface: Any) -> Triangles:
    """Return the vertices and triangles of a PyVista surface or of a pair of arrays."""
    if hasattr(surface, "regular_faces"):
        cut = surface.triangulate()
        surface = cut.points, cut.regular_faces
    if not isinstance(surface, tuple | list) or len(surface) != 2:
        raise ValueError(f"{type(surface).__name__}; must be (vertices, triangles) or a PyVista PolyData")
    vertices, triangles = (
        real_tensor(name, part).detach().cpu().numpy()
        for name, part in zip(("vertices", "triangles"), surface, strict=True)
    )
    if (triangles != np.trunc(triangles)).any():
        raise ValueError("triangles that are not whole numbers; must be indices of vertices, counted from 0")
    return vertices, triangles.clip(-1, _MOST).astype(np.int64)  # an index beyond is refused
