"""What is in the way: boxes, spheres, cylinders, meshes and voxels, of a material or rigid."""

from autdtorch.obstacles.base import Obstacle
from autdtorch.obstacles.box import Box
from autdtorch.obstacles.cylinder import Cylinder
from autdtorch.obstacles.mesh import Mesh
from autdtorch.obstacles.sphere import Sphere
from autdtorch.obstacles.voxel_mask import VoxelMask

__all__ = ["Box", "Cylinder", "Mesh", "Obstacle", "Sphere", "VoxelMask"]
