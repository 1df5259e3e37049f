"""Obstacles: boxes, spheres, cylinders, meshes and voxel masks, of a fluid material or rigid."""

from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.box import Box
from autdtorch.scene.obstacles.cylinder import Cylinder
from autdtorch.scene.obstacles.mesh import Mesh
from autdtorch.scene.obstacles.sphere import Sphere
from autdtorch.scene.obstacles.voxel_mask import VoxelMask

__all__ = ["Box", "Cylinder", "Mesh", "Obstacle", "Sphere", "VoxelMask"]
