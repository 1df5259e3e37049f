"""Obstacles: boxes, spheres, cylinders, meshes and voxel masks, of a fluid, rigid or with an impedance."""

from autdtorch.scene.obstacles.base import Obstacle as Obstacle
from autdtorch.scene.obstacles.kinds import KINDS as KINDS
from autdtorch.scene.obstacles.mesh import Mesh as Mesh
from autdtorch.scene.obstacles.primitives import Box as Box
from autdtorch.scene.obstacles.primitives import Cylinder as Cylinder
from autdtorch.scene.obstacles.primitives import Sphere as Sphere
from autdtorch.scene.obstacles.voxel_mask import VoxelMask as VoxelMask
