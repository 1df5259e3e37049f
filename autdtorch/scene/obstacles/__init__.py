"""Obstacles: boxes, spheres, cylinders, meshes and voxel masks, of a fluid, rigid or with an impedance.

An obstacle is a class and an entry in `KINDS`.
"""

from autdtorch.scene.obstacles.base import Obstacle as Obstacle
from autdtorch.scene.obstacles.mesh import Mesh as Mesh
from autdtorch.scene.obstacles.primitives import Box as Box
from autdtorch.scene.obstacles.primitives import Cylinder as Cylinder
from autdtorch.scene.obstacles.primitives import Sphere as Sphere
from autdtorch.scene.obstacles.voxel_mask import VoxelMask as VoxelMask

KINDS: dict[str, type[Obstacle]] = {
    "box": Box,
    "sphere": Sphere,
    "cylinder": Cylinder,
    "mesh": Mesh,
    "voxel_mask": VoxelMask,
}
"""The kinds of obstacles by their `type` in scene files; these, and no classes derived from them, are saved
and moved."""
