"""Scenes and fields in 3D, rendered off-screen with PyVista (optional extra ``viz``); lengths in mm."""

from autdtorch.rendering.animation import animate3d
from autdtorch.rendering.probe import rendering_problem
from autdtorch.rendering.view import view3d

__all__ = ["animate3d", "rendering_problem", "view3d"]
