"""The kinds of obstacles that a scene file may name.

An obstacle is a class and an entry in `KINDS`.
"""

from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.mesh import Mesh
from autdtorch.scene.obstacles.primitives import Box, Cylinder, Sphere
from autdtorch.scene.obstacles.voxel_mask import VoxelMask

KINDS: dict[str, type[Obstacle]] = {
    "box": Box,
    "sphere": Sphere,
    "cylinder": Cylinder,
    "mesh": Mesh,
    "voxel_mask": VoxelMask,
}
"""The kinds of obstacles by their `type` in scene files; these, and no classes derived from them, are saved
and moved."""
