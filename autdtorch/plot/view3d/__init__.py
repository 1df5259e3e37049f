"""Scenes and fields in 3D with PyVista (optional extra ``viz``), rendered off-screen; lengths in mm."""

from autdtorch.plot.view3d.views import animate3d, rendering_problem, view3d

__all__ = ["animate3d", "rendering_problem", "view3d"]
